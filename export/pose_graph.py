#!/usr/bin/env python3
"""From loops to a corrected drive: odometry and `ssrvlad loops --json` become a pose graph.

ssrvlad loops images/monday --labels-as camvid-11 --json > loops.jsonl
python export/pose_graph.py loops.jsonl --odometry odometry.tum -o corrected

The odometry is a file of TUM or KITTI, or a `poses.csv`, as `ssrvlad` reads them: poses on the
ground plane. `corrected/` gets `poses.tum` and `poses.csv` of the frames, `graph.g2o`, and
`drive.png`, the drive before and after. gtsam optimises the graph; graduated non-convexity (Yang et
al., RA-L 2020) refuses loops that contradict the odometry and the other loops; what is measured is
in docs/research/pose-graph.md. Needs `ssrvlad_torch[slam]`. Exit code 0 for success, 2 for wrong
use.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from ssrvlad_torch.datasets.pose_tables import read_poses, write_poses
from ssrvlad_torch.datasets.poses import Pose
from ssrvlad_torch.datasets.trajectories import read_trajectory
from ssrvlad_torch.files import replacing

try:
    import gtsam
except ImportError:
    sys.exit("pose_graph: gtsam is missing: pip install 'ssrvlad_torch[slam]'")

Floats = npt.NDArray[np.float64]

ALONG, ALONG_UNKNOWN, HEADING = 1.2, 1.6, math.radians(3.5)
"""Standard deviations of an accepted loop: metres along the drive with and without `ahead`, and
radians; measured on cities 100 to 103, see docs/research/pose-graph.md."""

SIDEWAYS = 1.5
"""Standard deviation in metres of the distance between two drives of a street: half a lane."""

ALIKE = 5
"""The errors of so many neighbouring loops are one error: a loop has the variance of one, times
this."""

MOST_UNLIKELY = 0.99
"""A loop within this quantile of its uncertainty is kept whatever the others say."""

EVEN = 0.5
"""A loop that is believed less is refused."""


class Odometry(NamedTuple):
    """How odometry errs: standard deviations per metre driven."""

    drift: float = 0.02
    turn: float = math.radians(0.1)


class Loop(NamedTuple):
    """A loop between rows of the drive: the frame is `ahead` metres in front of the candidate,
    ``None`` if that is unknown."""

    frame: int
    candidate: int
    ahead: float | None = None


class Corrected(NamedTuple):
    """Poses ``(N, 3)`` after optimisation, how much of each loop was believed ``(L,)`` from 0 to 1,
    and the graph."""

    poses: Floats
    believed: Floats
    graph: gtsam.NonlinearFactorGraph


def read_loops(lines: Iterable[str]) -> tuple[list[str], list[tuple[str, str, float | None]]]:
    """The frames of JSON lines of `ssrvlad loops` in order, and the accepted loops: frame,
    candidate and `ahead`.

    Raises:
        ValueError: a line has another form, or a frame or candidate has no line of its own.
    """
    frames, loops = dict[str, None](), list[tuple[str, str, float | None]]()
    for number, line in enumerate(lines, 1):
        try:
            result = json.loads(line)
            if "precision" in result:
                continue
            frame, accepted = str(result["frame"]), result["reason"] == "accepted"
            if accepted:
                loops.append((frame, str(result["candidate"]), result["ahead"]))
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"line {number}: expected JSON of `ssrvlad loops --json`, got {line.strip()[:60]!r}"
            ) from error
        if frame in frames:
            raise ValueError(f"line {number}: frame {frame!r} was there before")
        if accepted and loops[-1][1] not in frames:
            raise ValueError(
                f"line {number}: candidate {loops[-1][1]!r} has no line of its own; give the lines "
                "of the whole stream"
            )
        frames[frame] = None
    return list(frames), loops


def read_odometry(path: Path, frames: Sequence[str]) -> tuple[Floats, Sequence[float]]:
    """Poses ``(N, 3)`` of frames, NaN where unknown, and their stamps in seconds: their times or,
    where the file has none, their numbers.

    Raises:
        ValueError: the file has another form, or does not fit the frames.
    """
    stamps: Sequence[float] = range(len(frames))
    if path.suffix == ".csv":
        table = read_poses(path)
        poses = [table.get(frame, table.get(frame.rpartition("/")[2])) for frame in frames]
        found = [pose or Pose(math.nan, math.nan, math.nan) for pose in poses]
    else:
        names = [frame.rpartition("/")[2] for frame in frames]
        stamps, found = read_trajectory(path).timed(names)
    known = np.array(found, np.float64).reshape(-1, 3)
    if not np.isfinite(known).all(axis=1).any():
        raise ValueError(f"{path}: no pose with a heading for {len(frames)} frames")
    return known, stamps


def relative(one: Floats, other: Floats) -> Floats:
    """``(..., 3)``, a pose as seen from another."""
    east, north, _ = np.moveaxis(other - one, -1, 0)
    c, s = np.cos(one[..., 2]), np.sin(one[..., 2])
    turn = np.angle(np.exp(1j * (other[..., 2] - one[..., 2])))
    return np.stack((c * east + s * north, c * north - s * east, turn), axis=-1)


def moved(one: Floats, by: Floats) -> Floats:
    """``(..., 3)``, the inverse of `relative`: a pose by another that sees it so."""
    c, s = np.cos(one[..., 2]), np.sin(one[..., 2])
    x, y, turn = np.moveaxis(by, -1, 0)
    east, north = one[..., 0] + c * x - s * y, one[..., 1] + s * x + c * y
    return np.stack((east, north, one[..., 2] + turn), axis=-1)


def in_front(poses: Floats, row: int, metres: float) -> Floats:
    """``(3,)``, the pose on a drive so many metres in front of a row, by steps in straight lines;
    beyond its ends the drive goes straight on."""
    step, left = (1 if metres >= 0 else -1), abs(metres)
    while 0 <= row + step < len(poses):
        there = relative(poses[row], poses[row + step])
        if (length := float(np.hypot(*there[:2]))) > left:
            return moved(poses[row], there * (left / length))
        row, left = row + step, left - length
    return moved(poses[row], np.array([step * left, 0.0, 0.0]))


def measured(poses: Floats, loop: Loop, drives: Sequence[slice]) -> Floats:
    """``(3,)``, the pose of a loop's frame as seen from its candidate."""
    [drive] = (rows for rows in drives if rows.start <= loop.candidate < rows.stop)
    row = loop.candidate - drive.start
    return relative(poses[loop.candidate], in_front(poses[drive], row, loop.ahead or 0.0))


def placed(poses: Floats, drives: Sequence[slice], loops: Sequence[Loop]) -> Floats:
    """Poses ``(N, 3)`` of drives in the world of the first: each later drive stands where most of
    its loops put it.

    Raises:
        ValueError: a drive has no loop with an earlier one.
    """
    poses = poses.copy()
    for drive in drives[1:]:
        ties = [x for x in loops if x.candidate < drive.start <= x.frame < drive.stop]
        if not ties:
            raise ValueError(f"frames {drive.start} to {drive.stop - 1} have no loop with earlier")
        there = np.stack([moved(poses[x.candidate], measured(poses, x, drives)) for x in ties])
        start = relative(poses[[x.frame for x in ties]], np.zeros(3))
        worlds = moved(there, start)
        apart = relative(worlds[:, None], worlds[None])
        near = (np.hypot(apart[..., 0], apart[..., 1]) < 20) & (np.abs(apart[..., 2]) < 0.2)
        poses[drive] = moved(worlds[near.sum(1).argmax()], poses[drive])
    return poses


def correct(
    poses: Floats,
    loops: Sequence[Loop],
    odometry: Odometry | None = None,
    sideways: float = SIDEWAYS,
    drives: Sequence[slice] = (),
) -> Corrected:
    """Corrects a drive by its loops; those that contradict the odometry and the others are refused.

    Args:
        poses: ``(N, 3)`` of the odometry, x and y in metres, heading in radians.
        loops: between rows.
        odometry: how it errs.
        sideways: standard deviation in metres of the distance between two drives of one street.
        drives: rows of each drive in order; without, all are one.

    Examples:
        >>> square = np.array([[0, 0, 0], [9, 0, 1.6], [9, 9, 3.2], [0, 9, 4.8], [1, 1, 6.4]])
        >>> correct(square, [Loop(4, 0)]).poses.shape
        (5, 3)
    """
    odometry, drives = odometry or Odometry(), drives or [slice(0, len(poses))]
    start = placed(poses, drives, loops)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for row, pose in enumerate(start):
        values.insert(row, gtsam.Pose2(*pose))
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), _noise(1e-3, 1e-3, 1e-4)))
    for drive in drives:
        for row in range(drive.start, drive.stop - 1):
            graph.add(_step(row, relative(poses[row], poses[row + 1]), odometry))
    certain, alike = graph.size(), math.sqrt(ALIKE)
    for loop in loops:
        along = ALONG_UNKNOWN if loop.ahead is None else ALONG
        noise = _noise(along * alike, sideways * alike, HEADING * alike)
        seen = gtsam.Pose2(*measured(start, loop, drives))
        graph.add(gtsam.BetweenFactorPose2(loop.candidate, loop.frame, seen, noise))
    if not loops:
        return Corrected(start, np.ones(0), graph)
    settings = gtsam.GncLMParams()
    settings.setKnownInliers(list(range(certain)))
    settings.setLossType(gtsam.GncLossType.TLS)
    optimiser = gtsam.GncLMOptimizer(graph, values, settings)
    optimiser.setInlierCostThresholdsAtProbability(MOST_UNLIKELY)
    result, believed = optimiser.optimize(), optimiser.getWeights()[certain:]
    best = [result.atPose2(row) for row in range(len(poses))]
    after = np.array([[pose.x(), pose.y(), pose.theta()] for pose in best])
    return Corrected(after, believed, graph)


def _step(row: int, step: Floats, odometry: Odometry) -> gtsam.BetweenFactorPose2:
    """What the odometry says of a row and the next."""
    metres = math.sqrt(max(0.1, math.hypot(step[0], step[1])))
    turn = odometry.turn * metres
    noise = _noise(odometry.drift * metres, odometry.drift * metres, turn)
    return gtsam.BetweenFactorPose2(row, row + 1, gtsam.Pose2(*step), noise)


def _noise(along: float, sideways: float, turn: float) -> gtsam.noiseModel.Diagonal:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([along, sideways, turn]))


def write(
    folder: Path,
    frames: Sequence[str],
    stamps: Sequence[float],
    before: Floats,
    after: Corrected,
    loops: Sequence[Loop],
) -> None:
    """Writes `poses.tum`, `poses.csv`, `graph.g2o` and `drive.png` into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = [Pose(*map(float, pose)) for pose in after.poses]
    write_poses(folder / "poses.csv", dict(zip(frames, poses, strict=True)))
    with replacing(folder / "poses.tum") as temporary:
        lines = [tum_line(*pair) for pair in zip(stamps, poses, strict=True)]
        temporary.write_text("".join(lines), encoding="utf-8")
    values = gtsam.Values()
    for row, pose in enumerate(after.poses):
        values.insert(row, gtsam.Pose2(*pose))
    with replacing(folder / "graph.g2o") as temporary:
        gtsam.writeG2o(after.graph, values, str(temporary))
    with replacing(folder / "drive.png") as temporary:
        draw(before, after, loops).savefig(temporary, format="png", dpi=110)


def tum_line(stamp: float, pose: Pose) -> str:
    """A line of TUM: a camera that looks along the heading, in a world whose z is up."""
    half = (pose.heading - math.pi / 2) / 2
    c, s, root = math.cos(half), math.sin(half), math.sqrt(0.5)
    numbers = (pose.x, pose.y, 0.0, -root * c, -root * s, root * s, root * c)
    return " ".join([f"{stamp:.6f}", *(f"{number:.6f}" for number in numbers)]) + "\n"


def draw(before: Floats, after: Corrected, loops: Sequence[Loop]) -> Figure:
    """The drive before and after; believed loops are green, refused ones red."""
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    for axes, poses, title in zip(
        figure.subplots(1, 2), (before, after.poses), ("odometry", "corrected"), strict=True
    ):
        axes.plot(*poses[:, :2].T, lw=1, color="#444444")
        for loop, believed in zip(loops, after.believed, strict=True):
            ends = poses[[loop.candidate, loop.frame], :2]
            axes.plot(*ends.T, lw=0.6, color="#1a7f37" if believed >= EVEN else "#cf222e")
        axes.set(title=title, aspect="equal", xlabel="m", ylabel="m")
        axes.grid(lw=0.3)
    return figure


def run(options: argparse.Namespace) -> str:
    """Reads, corrects and writes; what to say."""
    text = sys.stdin.read() if str(options.loops) == "-" else options.loops.read_text("utf-8")
    frames, closed = read_loops(text.splitlines())
    poses, stamps = read_odometry(options.odometry, frames)
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    row = {frames[number]: place for place, number in enumerate(known.tolist())}
    closed = [loop for loop in closed if loop[0] in row and loop[1] in row]
    loops = [Loop(row[frame], row[there], ahead) for frame, there, ahead in closed]
    names = [frames[number] for number in known]
    ends = np.cumsum([len([*drive]) for _, drive in groupby(n.rpartition("/")[0] for n in names)])
    drives = [slice(a, b) for a, b in pairwise([0, *ends.tolist()])]
    drift = Odometry(options.drift, math.radians(options.turn))
    after = correct(poses[known], loops, drift, options.sideways, drives)
    there = [stamps[number] for number in known]
    write(options.output, names, there, poses[known], after, loops)
    refused = int((after.believed < EVEN).sum())
    return f"{len(names)} poses, {len(loops)} loops, {refused} refused: {options.output}"


def main() -> int:
    """The command line; errors are one line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    usual = Odometry()
    parser.add_argument("loops", type=Path, help="lines of `ssrvlad loops --json`, or -")
    parser.add_argument("--odometry", type=Path, required=True, help="TUM, KITTI or poses.csv")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--drift", type=float, default=usual.drift, help="m after a metre")
    parser.add_argument(
        "--turn", type=float, default=math.degrees(usual.turn), help="degrees after a metre"
    )
    parser.add_argument("--sideways", type=float, default=SIDEWAYS, help="m between two drives")
    options = parser.parse_args()
    if min(options.drift, options.turn, options.sideways) <= 0:
        parser.error("expected --drift, --turn and --sideways above 0")
    try:
        print(run(options))
    except (ValueError, OSError) as error:
        print(f"pose_graph: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
