"""Small copies of data sets, as their archives unpack, and stored results of VPR-Bench with what
its own code prints for them.

``vpr_bench_corridor.json`` is one of them, CoHOG on the corridor data set (Zaffar et al., IJCV
2021; MIT): best scores, first ten candidates, ground truth, and the figures.
"""

import json
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers import write_image
from PIL import ExifTags, Image

from ssrvlad_torch.datasets.dataset import Dataset

CITIES = {
    "train/aachen": ["aachen_000000_000019", "aachen_000001_000019", "aachen_000010_000019"],
    "val/frankfurt": ["frankfurt_000000_000294", "frankfurt_000000_000576"],
    "test/berlin": ["berlin_000000_000019"],
}
FIX = {"gpsHeading": 281, "gpsLatitude": 50.78, "gpsLongitude": 6.1, "speed": 10.8}
DRIVES = {
    "0001TP": ["0001TP_006690", "0001TP_008550"],
    "0006R0": ["0006R0_f00930"],
    "0016E5": ["0016E5_07959"],
    "Seq05VD": ["Seq05VD_f00000"],
}
STILLS = [name for names in DRIVES.values() for name in names]
FRONT = "Stereo_Left/Omni_F"
FALL, NIGHT = "SYNTHIA-SEQS-04-FALL", "SYNTHIA-SEQS-04-NIGHT"
TIMES = (1417176458999821, 1417176459082965)
MAP, AUTUMN, OCTOBER = 1303398475046031, 1285948800000000, 1287446410000000
"""Microseconds of 2011-04-21 at 15:07, 2010-10-01 at 16:00 and 2010-10-19 at 00:00 (UTC)."""


def cityscapes(root):
    for city, names in CITIES.items():
        for name in names:
            annotation = f"gtFine/{city}/{name}_gtFine"
            plant(root, f"leftImg8bit/{city}/{name}_leftImg8bit.png")
            plant(root, f"{annotation}_labelIds.png", f"{annotation}_color.png")
            write(root / f"{annotation}_polygons.json", "{}")
            write(root / f"vehicle/{city}/{name}_vehicle.json", json.dumps(FIX))


def camvid(root):
    """The two archives of Cambridge, unpacked side by side, and the list of colours."""
    for name in STILLS:
        plant(root, f"701_StillsRaw_full/{name}.png", f"LabeledApproved_full/{name}_L.png")
    (root / "label_colors.txt").touch()


def camvid_in_splits(root):
    camvid(root)
    (root / "701_StillsRaw_full").rename(root / "train")
    (root / "LabeledApproved_full").rename(root / "train_labels")


def camvid_of_the_tutorial(root):
    """The SegNet tutorial: the first drive is in two splits."""
    for split, numbers in (("train", (0, 2)), ("val", (3,)), ("test", (1, 4))):
        for number in numbers:
            plant(root, f"{split}/{STILLS[number]}.png", f"{split}annot/{STILLS[number]}.png")
        (root / f"{split}.txt").touch()


def camvid_by_drive(root):
    for name in ("0016E5/{}/000390.{}", "0016E5/{}/000420.{}", "0001TP/{}/006690.{}"):
        plant(root, name.format("images", "jpg"))
        plant(root, *(name.format(folder, "png") for folder in ("labels", "predicted_net")))


def synthia(root):
    """Two seasons of a front camera, of different lengths, one with a second camera. The camera
    looks along z."""
    for season, count in ((NIGHT, 3), (FALL, 4)):
        for number in range(count):
            name, kinds = f"{FRONT}/{number:06d}", ("RGB", "GT/COLOR", "GT/LABELS")
            plant(root / season, *(f"{kind}/{name}.png" for kind in kinds))
            matrix = f"1 0 0 0 0 1 0 0 0 0 -1 0 {2 * number} 1.5 10 1"
            write(root / season / f"CameraParams/{name}.txt", matrix)
        write(root / season / "CameraParams/intrinsics.txt", "532.740352\n\n640\n\n380\n\n0.8\n")
    plant(root / FALL, "RGB/Stereo_Right/Omni_B/000000.png")


def robotcar(root):
    """As it is unpacked; the models were built from PNGs. Every camera is level and looks north."""
    names = [f"overcast-reference/{side}/{t}" for side in ("left", "rear", "right") for t in TIMES]
    names += ["dawn/rear/1418721355795420", "dawn/rear/1418721356878649"]
    names.append("night-rain/rear/1418840450664292")
    plant(root / "images", *(f"{name}.jpg" for name in names))
    shown = (("./", names[2], 100, 20), ("", names[3], 101, 20), ("", names[0], 100.5, 20))
    cameras = [
        f"{prefix}{name}.png 400 0.5 -0.5 -0.5 -0.5 {x} {y} -2.5 0 0"
        for prefix, name, x, y in shown
    ]
    write(root / "3D-models/all-merged/all.nvm", ["NVM_V3 ", "", "3", *cameras, "", "0"])
    write(root / "robotcar_v2_train.txt", [f"{names[6]}.png 0 0 1 103 1 0 0 21 0 1 0 -2.5 0 0 0 1"])
    write(root / "intrinsics/rear_intrinsics.txt", "fx 400.0\n")


def image(number, camera, time):
    return f"img_{number:05d}_c{camera}_{time}us"


def extended_cmu(root):
    """Slices 6 and 7 as their archives unpack; half of the query images have poses."""
    reference = [image(n, c, MAP + n) for n in (99, 100, 101) for c in (0, 1)]
    queries = [image(n, 0, AUTUMN + n) for n in (9, 10, 11)] + [image(5, 0, OCTOBER)]
    places = {
        "slice7/database": reference,
        "slice7/query": queries,
        "slice6/database": [image(7, 0, MAP)],
        "slice6/query": [image(8, 1, OCTOBER)],
    }
    plant(root, *(f"{place}/{name}.jpg" for place, names in places.items() for name in names))
    write(root / "intrinsics.txt", "c0 OPENCV 1024 768 868.99 866.06 525.94 420.04\n")
    lists = {
        "ground-truth-database-images-slice7": [(f, n, 2 * n) for n, f in enumerate(reference)],
        "camera-poses/a": [(queries[0], 7, 8)],
        "camera-poses/b": [(queries[3], 5, 6)],
        "camera-poses/empty": [],
        "../slice6/ground-truth-database-images-slice6": [],
    }
    for place, poses in lists.items():
        level_north = [f"{name}.jpg 0.5 0.5 -0.5 0.5 {x} {y} 1.5" for name, x, y in poses]
        write(root / "slice7" / f"{place}.txt", ["", *level_north])
    write(root / "slice7/test-images-slice7.txt", queries)


def vpr_bench(root):
    """The text and the second ground truth come with some of the sets. Row 10 of the ground truth
    is the image 10, not the image that sorts tenth as text."""
    plant(root, *(f"query/{n:07d}.jpg" for n in range(11)), *(f"ref/{n}.jpg" for n in range(12)))
    for name in ("ground_truth_new.json", "ReadMe.txt", "query/Thumbs.db"):
        (root / name).touch()


def plant(root: Path, *names: str) -> Path:
    """Tiny images of the formats that their names say; the folders are made."""
    for name in names:
        write_image(root / name, np.zeros((4, 6, 3), np.uint8))
    return root


def write_placed(
    path: Path,
    latitude: tuple[float, ...],
    longitude: tuple[float, ...],
    status: str = "A",
    letters: str = "NE",
) -> None:
    """A picture with its place, degrees, minutes and seconds, in EXIF tags; it looks north. Status
    V is a void position."""
    tag, exif = ExifTags.GPS, Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({
        tag.GPSLatitudeRef: letters[0], tag.GPSLatitude: latitude,
        tag.GPSLongitudeRef: letters[1], tag.GPSLongitude: longitude,
        tag.GPSStatus: status, tag.GPSImgDirectionRef: "T", tag.GPSImgDirection: 0.0,
    })  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def write(path: Path, lines: Iterable[str] | str) -> Path:
    """A text file; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(lines if isinstance(lines, str) else "".join(f"{line}\n" for line in lines))
    return path


def outline(dataset: Dataset) -> dict[str, list[str]]:
    """Names of the frames by sequence, in order."""
    return {
        sequence: [frame.name for frame in dataset.frames if frame.sequence == sequence]
        for sequence in dataset.sequences
    }


def roles(dataset: Dataset) -> dict[str, str | None]:
    """Roles by sequence."""
    return {frame.sequence: frame.role for frame in dataset.frames}


VPR_BENCH = Path(__file__).parents[2] / "shared" / "data" / "vprbench"

needs_vpr_bench = pytest.mark.skipif(
    not VPR_BENCH.is_dir(), reason="the VPR-Bench results of ../shared/data are not here"
)


CORRIDOR = VPR_BENCH / "corridor"
needs_corridor = pytest.mark.skipif(
    not CORRIDOR.is_dir(), reason="the corridor images of ../shared/data are not here"
)


class Stored(NamedTuple):
    """What a technique found, and what VPR-Bench prints for it."""

    name: str
    scores: np.ndarray
    candidates: np.ndarray
    truth: list[np.ndarray]
    expected: dict[str, Any]


def frozen_corridor() -> Stored:
    content = json.loads((Path(__file__).parent / "vpr_bench_corridor.json").read_text())
    candidates = np.array(content["candidates"])
    scores = np.full(candidates.shape, -np.inf)
    scores[:, 0] = content["score"]
    truth = [np.arange(first, last + 1) for first, last in content["first_and_last_match"]]
    return Stored("frozen corridor", scores, candidates, truth, content["expected"])


def stored_results() -> Iterator[Stored]:
    expected = json.loads((VPR_BENCH / "expected.json").read_text())
    for data_set, techniques in expected.items():
        for technique, figures in techniques.items():
            stored = np.load(VPR_BENCH / f"{data_set}_{technique}.npz")
            truth = [stored["gt_flat"][a:b].astype(np.int64) for a, b in pairwise(stored["gt_off"])]
            candidates = np.argsort(-stored["sim"], axis=1, kind="stable")[:, :10]
            assert (candidates[:, 0] == stored["match"]).all()
            scores = np.take_along_axis(stored["sim"], candidates, 1).astype(np.float64)
            scores[:, 0] = stored["score"]
            yield Stored(f"{data_set} {technique}", scores, candidates, truth, figures)
