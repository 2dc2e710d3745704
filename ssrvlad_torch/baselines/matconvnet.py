"""Networks that MatConvNet saved: MATLAB files of version 5 to 7, read with SciPy.

A network is a variable ``net`` with a cell ``layers`` of structs with ``name`` and ``weights``.
NetVLAD's own layers are MATLAB objects. The cell holds references to them. The objects are in a
second, unnamed MAT stream after the variables (SciPy calls it ``__function_workspace__``), as the
structs that the class's ``saveobj`` wrote.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from ..files import one_line, requiring

_WORKSPACE = "__function_workspace__"
_HEADER = b"MATLAB 5.0 MAT-file"

Array = npt.NDArray[np.float32]


class MatConvNet(NamedTuple):
    """The content of a MatConvNet file: the arrays of each layer with weights, by its name, in
    MATLAB's shapes, for a convolution ``(h, w, in, out)`` and the biases; and the first pixel
    ``(3,)`` of the average image, RGB of 0 to 255."""

    weights: dict[str, list[Array]]
    average: Array


def read_matconvnet(path: Path) -> MatConvNet:
    """Reads a network, saved with its layers as structs or as objects. A file that is damaged, of
    MATLAB's version 7.3 or without such a network is a ValueError, no SciPy an ImportError."""
    with path.open("rb") as file:
        content = _load(file, path)
    try:
        net = content["net"][0, 0]
        normalization = net["meta"][0, 0]["normalization"][0, 0]
        average = np.asarray(normalization["averageImage"], np.float32).reshape(-1, 3)[0]
        layers = [*net["layers"].ravel(), *_saved_objects(content, path)]
        weights = {
            str(layer["name"][0, 0].item()): [np.asarray(w, np.float32) for w in cell.ravel()]
            for layer in layers
            if (cell := _weights(layer)) is not None
        }
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise ValueError(
            f"{path} must hold a MatConvNet network, net with layers and "
            f"meta.normalization.averageImage: {error}"
        ) from error
    return MatConvNet(weights, average)


def _load(stream: BinaryIO, path: Path) -> dict[str, Any]:
    with requiring("eval", "MATLAB files need"):
        from scipy.io import loadmat
    try:
        content: dict[str, Any] = loadmat(stream)
    except NotImplementedError as error:
        raise ValueError(
            f"{path} is a MATLAB file of version 7.3; save it again in MATLAB with -v7"
        ) from error
    except Exception as error:  # SciPy raises many kinds of errors for damaged bytes
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ValueError(f"{path} is not a whole MATLAB file: {one_line(error)}") from error
    return content


def _saved_objects(content: dict[str, Any], path: Path) -> Iterator[Any]:
    """The structs of the objects in a file. Their stream starts with the last four bytes of a MAT
    header and four of padding: with a complete header in place of these eight it is a MAT file."""
    if _WORKSPACE in content:
        stream = content[_WORKSPACE].tobytes()
        inner = _load(BytesIO(_HEADER.ljust(124) + stream[:4] + stream[8:]), path)
        wrapper = inner[_WORKSPACE]["MCOS"][0, 0]
        yield from wrapper[0]["arr"].ravel()


def _weights(layer: Any) -> npt.NDArray[Any] | None:
    """The cell of a layer's weights; None if ``layer`` has no weights or is not a layer."""
    names = getattr(getattr(layer, "dtype", None), "names", None) or ()
    if not {"name", "weights"} <= set(names) or layer.size != 1:
        return None
    cell = layer["weights"][0, 0]
    return cell if cell.size and cell.dtype == object else None
