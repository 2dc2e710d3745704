"""Networks that MatConvNet saved: MATLAB files of version 5 to 7, read with SciPy.

A network is a variable ``net`` with a cell ``layers`` of structs with ``name`` and ``weights``.
NetVLAD's own layers are MATLAB objects: the cell refers to them, and the structs that their
``saveobj`` wrote are in a second MAT stream, SciPy's ``__function_workspace__``.
"""

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
    """The arrays of each layer with weights, by its name, in MATLAB's shapes, for a convolution
    ``(h, w, in, out)`` and the biases; and the first pixel ``(3,)`` of the average image, RGB of 0
    to 255."""

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
        layers = [*net["layers"].ravel()]
        if _WORKSPACE in content:
            # It starts with the last four bytes of a header of 128, and four of padding.
            stream = content[_WORKSPACE].tobytes()
            inner = _load(BytesIO(_HEADER.ljust(124) + stream[:4] + stream[8:]), path)
            layers += [*inner[_WORKSPACE]["MCOS"][0, 0][0]["arr"].ravel()]
        weights = dict[str, list[Array]]()
        for layer in layers:
            names = getattr(getattr(layer, "dtype", None), "names", None) or ()
            if {"name", "weights"} <= set(names) and layer.size == 1:
                cell = layer["weights"][0, 0]
                if cell.size and cell.dtype == object:
                    arrays = [np.asarray(array, np.float32) for array in cell.ravel()]
                    weights[str(layer["name"][0, 0].item())] = arrays
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
