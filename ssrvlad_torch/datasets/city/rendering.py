"""Rendering of the city: bodies painted from far to near, each as the hull of its corners."""

import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ..poses import Pose
from .blocks import BUILDING, ROAD, SKY, VEGETATION, Bodies
from .streets import FAR, generator

CAMERA_HEIGHT = 1.5
FIELD_OF_VIEW = math.radians(85)
NEAR = 0.3
SMALLEST_PIXELS = 0.35  # thinner bodies are not painted


def background(seed: int, pose: Pose, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Sky, road, and between them distant roofs and trees without parallax."""
    height, width = size
    across = (np.arange(width) + 0.5 - width / 2) / _focal(width)
    bearing = (pose.heading - np.arctan(across)) % math.tau
    heights, classes = generator(seed, "horizon").random((2, 120))
    sector = (bearing / math.tau * 120).astype(int) % 120
    top = height / 2 - _focal(width) * np.tan(np.radians(0.3 + 3.5 * heights[sector]))
    rows = np.arange(height)[:, None] + 0.5
    far = np.where(classes[sector] < 0.6, BUILDING, VEGETATION)
    return np.where(rows < top, SKY, np.where(rows < height / 2, far, ROAD)).astype(np.uint8)


def paint(labels: NDArray[np.uint8], groups: list[Bodies], pose: Pose) -> NDArray[np.uint8]:
    """A copy of the background ``labels`` ``(H, W)`` with bodies painted on it: flat bodies in
    their order, then the others from far to near."""
    visible = [_in_view(group, pose) for group in groups]
    ids = np.concatenate([bodies.labels for bodies in visible])
    corners = np.concatenate([bodies.corners for bodies in visible])
    centre = corners.mean(axis=1)
    has_height = np.ptp(corners[..., 2], axis=1) > 0
    distance = np.where(has_height, np.hypot(centre[:, 0], centre[:, 1]), np.inf)
    order = np.argsort(-distance, kind="stable")
    image = Image.fromarray(labels)
    draw = ImageDraw.Draw(image)
    whole = corners[..., 0].min(axis=1) > NEAR
    pixels = _project(corners, labels.shape)
    large = np.ptp(pixels, axis=1).min(axis=1) > SMALLEST_PIXELS
    for index in order[(large | ~whole)[order]].tolist():
        near = not whole[index]
        points = _project(_cut_near(corners[index]), labels.shape) if near else pixels[index]
        draw.polygon(_hull(np.floor(points).tolist()), fill=int(ids[index]))
    return np.array(image)


def _in_view(bodies: Bodies, pose: Pose) -> Bodies:
    """The bodies in the field of view, their corners in metres (ahead, to the right, up)."""
    east, north, up = np.moveaxis(bodies.corners - (pose.x, pose.y, CAMERA_HEIGHT), -1, 0)
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    ahead, right = east * cos + north * sin, east * sin - north * cos
    reach = math.tan(FIELD_OF_VIEW / 2) * ahead
    visible = (ahead > NEAR).any(axis=1) & (ahead < FAR).any(axis=1)
    visible &= (right < reach).any(axis=1) & (right > -reach).any(axis=1)
    corners = np.stack((ahead[visible], right[visible], up[visible]), axis=-1)
    return Bodies(bodies.labels[visible], corners)


def _project(points: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Pixel coordinates (column, row) of points in metres (ahead, right, up)."""
    height, width = shape
    scale = _focal(width) / np.maximum(points[..., :1], NEAR)
    return points[..., 1:] * (1, -1) * scale + (width / 2, height / 2)


def _cut_near(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the part of a convex body beyond the near plane: those ahead of it, and where the
    lines between corners behind and ahead, which are all inside the body, cross it."""
    ahead = corners[corners[:, 0] >= NEAR]
    behind = corners[corners[:, 0] < NEAR]
    start, step = behind[:, None], ahead[None] - behind[:, None]
    crossings = start + step * (NEAR - start[..., :1]) / step[..., :1]
    return np.concatenate((ahead, crossings.reshape(-1, 3)))


def _hull(points: list[list[float]]) -> list[tuple[float, float]]:
    """Convex hull by Andrew's monotone chain."""
    ordered = sorted(set(map(tuple, points)))
    outline: list[tuple[float, float]] = []
    for chain in (ordered, ordered[::-1]):
        begin = len(outline)
        for x, y in chain:
            while len(outline) - begin > 1:
                (ax, ay), (bx, by) = outline[-2:]
                if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                    break
                outline.pop()
            outline.append((x, y))
    return outline


def _focal(width: int) -> float:
    """Focal length in pixels."""
    return width / 2 / math.tan(FIELD_OF_VIEW / 2)
