"""Opening a data set, whose layout is recognised by its files."""

from itertools import islice
from pathlib import Path

from natsort import natsorted

from . import camvid, cityscapes, extended_cmu, folders, robotcar, synthia, vpr_bench
from .dataset import Dataset, LabelsAs, Layout, folders_in, shortened

LAYOUTS: tuple[Layout, ...] = (
    extended_cmu.LAYOUT,
    robotcar.LAYOUT,
    synthia.LAYOUT,
    cityscapes.LAYOUT,
    camvid.LAYOUT,
    vpr_bench.LAYOUT,
    folders.LAYOUT,
)
"""The layouts in the order in which they are tried; plain folders, which accept most data, last."""

AUTO = "auto"
_MOST = 1000


def open_dataset(
    path: str | Path,
    layout: str | None = None,
    labels: str | Path | None = None,
    labels_as: LabelsAs = None,
) -> Dataset:
    """The data set in a folder.

    Args:
        path: the folder.
        layout: name of a layout; if ``None`` or ``"auto"``, the first in `LAYOUTS` that recognises
            the folder.
        labels: a folder of label maps that replace those of the data set, or the name of such a
            folder beside each folder of images; see `Dataset.with_labels`.
        labels_as: label space of the label maps; ``None`` for that of the layout.

    Raises:
        ValueError: the folder or the layout does not exist, no layout recognises the folder, it
            lacks files that the layout requires, a file is damaged, or ``labels`` is given without
            ``labels_as``. The message is one line.

    Examples:
        >>> city = open_dataset("/data/SYNTHIA", labels_as="synthia")  # doctest: +SKIP
        >>> night = city.select(["SYNTHIA-SEQS-04-NIGHT-Stereo_Left-Omni_F"])  # doctest: +SKIP
        >>> night.label_files()[0].frame  # doctest: +SKIP
        'SYNTHIA-SEQS-04-NIGHT-Stereo_Left-Omni_F/000000'
    """
    root = Path(path)
    if not root.is_dir():
        raise ValueError(f"{root} is no folder; expected the folder of a data set")
    if labels is not None and labels_as is None:
        raise ValueError(f"the label maps in {labels} need a label space")
    chosen = _layout_of(root, None if layout == AUTO else layout)
    dataset = chosen.read(root, labels_as)
    if not dataset.traverses:
        raise ValueError(
            f"{root} ({chosen.name}) holds no frames: expected {chosen.expected}; the data set is "
            f"at {chosen.origin}"
        )
    if labels is not None and labels_as is not None:
        return dataset.with_labels(labels, labels_as)
    return dataset


def _layout_of(root: Path, name: str | None) -> Layout:
    """The layout of this name, or the first that recognises the folder; else a ValueError."""
    layouts = [layout for layout in LAYOUTS if name in (None, layout.name)]
    if not layouts:
        names = ", ".join(layout.name for layout in LAYOUTS)
        raise ValueError(f"unknown layout {name!r}; expected one of {names}")
    for layout in layouts:
        if layout.recognises(root):
            return layout
    if name is None:
        expected = "; ".join(f"{layout.name}: {layout.expected}" for layout in layouts)
        raise ValueError(
            f"{root} is in no known layout; found {_content(root)}; expected one of {expected}"
        )
    origin = f"; the data set is at {layouts[0].origin}" if layouts[0].origin else ""
    raise ValueError(
        f"{root} is not in the layout {name}: expected {layouts[0].expected}; found "
        f"{_content(root)}{origin}"
    )


def _content(root: Path) -> str:
    """Names of the files and folders in a folder and in its folders, shortened."""
    inside = [
        f"{folder.name}/{entry.name}"
        for folder in folders_in(root)
        for entry in [*islice(folder.iterdir(), _MOST)] or [Path()]
    ]
    files = [entry.name for entry in islice(root.iterdir(), _MOST) if not entry.is_dir()]
    return shortened(natsorted(sorted(inside + files)))
