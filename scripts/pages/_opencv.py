"""The preset ``paper`` written with OpenCV, one layer after another."""

from __future__ import annotations

import cv2
import numpy as np

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.config import CATEGORY_COUNT
from ssrvlad_torch.taxonomy import label_space


def opencv_describe(labels: np.ndarray, config: SSRVLADConfig) -> np.ndarray:
    """The preset ``paper`` written with OpenCV, one layer after another."""
    table = np.full(256, CATEGORY_COUNT, np.uint8)
    for label in label_space(config.labels_as).classes:
        if 0 <= label.id < 256:
            table[label.id] = label.category_index
    categories = cv2.LUT(labels, table)
    vectors = []
    for k in range(CATEGORY_COUNT):
        layer = opencv_clean((categories == k).astype(np.uint8), config)
        vectors.append(opencv_vector(layer, config))
    whole = np.concatenate(vectors)
    norm = np.linalg.norm(whole)
    return (whole / norm if norm else whole).astype(np.float32)


def opencv_clean(layer: np.ndarray, config: SSRVLADConfig) -> np.ndarray:
    size = layer.shape
    radius = config.radius_pixels(config.closing, *size)
    if radius:
        square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        layer = cv2.erode(cv2.dilate(layer, square), square)
    _, regions, stats, _ = cv2.connectedComponentsWithStats(1 - layer, connectivity=4)
    left, top, width, height, area = stats.T
    enclosed = (left > 0) & (top > 0) & (left + width < size[1]) & (top + height < size[0])
    fill = enclosed & (area < config.area_pixels(config.hole_area, *size))
    fill[0] = False
    layer = layer | fill[regions].astype(np.uint8)
    _, regions, stats, _ = cv2.connectedComponentsWithStats(layer, connectivity=8)
    keep = stats[:, 4] >= config.area_pixels(config.region_area, *size)
    keep[0] = False
    return keep[regions].astype(np.uint8)


def opencv_vector(layer: np.ndarray, config: SSRVLADConfig) -> np.ndarray:
    padded = cv2.copyMakeBorder(layer * 255, 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    skeleton = (cv2.ximgproc.thinning(padded) > 0)[2:-2, 2:-2]
    ends, crossings = reference.end_points(skeleton), reference.intersections(skeleton)
    points, context = np.argwhere(ends | crossings), np.argwhere(skeleton)
    size = config.rings * config.sectors
    if not len(points):
        return np.zeros(size)
    y, x = np.nonzero(layer)
    centre = [(2 * y.sum() + len(y)) // (2 * len(y)), (2 * x.sum() + len(x)) // (2 * len(x))]
    limits = np.array(config.ring_limits(*layer.shape))
    dy, dx = (context[None] - np.concatenate(([centre], points))[:, None]).transpose(2, 0, 1)
    squared = dy * dy + dx * dx
    turn = np.arctan2(dy, dx) / (2 * np.pi)
    sector = np.floor(turn * config.sectors + 1e-12).astype(int) % config.sectors
    bins = np.searchsorted(limits, squared) * config.sectors + sector
    bins[(squared == 0) | (squared > limits[-1])] = size
    around_centre = np.bincount(bins[0], minlength=size + 1)[:size]
    around_points = np.bincount(bins[1:].ravel(), minlength=size + 1)[:size]
    vector = (around_points - len(points) * around_centre).astype(np.float64)
    norm = np.linalg.norm(vector)
    return vector / norm if norm else vector
