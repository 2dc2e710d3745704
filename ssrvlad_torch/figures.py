"""Figures of matplotlib (extra ``eval``), and files of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .files import check_output, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def require_picture(path: Path) -> None:
    """Raises the errors of `write_picture` before the picture is drawn.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: matplotlib cannot write the format.
        OSError: see `check_output`.
    """
    formats = new_figure(1, 1).canvas.get_supported_filetypes()
    if _format(path) not in formats:
        raise ValueError(f"{path}: a picture is one of {', '.join(formats)}")
    check_output(path)


def write_picture(figure: Figure, path: Path) -> None:
    """Writes a figure, completely or not at all, in the format of the suffix, by default PNG.

    Raises:
        ValueError, OSError: see `require_picture`; or the disk reports an error.
    """
    require_picture(path)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=_format(path))


def new_figure(width: float, height: float) -> Figure:
    """An empty figure; width and height in inches.

    Raises:
        ImportError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need: pip install ssrvlad-torch[eval]") from error
    return Figure(figsize=(width, height), layout="constrained")


def _format(path: Path) -> str:
    return path.suffix.removeprefix(".").lower() or "png"
