"""Weights on disk: where they are looked for, how a checkpoint is read, how a network takes them.

Nothing is ever downloaded. A method looks for its published files by name in one folder, or takes
the file that it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


def weights_folder() -> Path:
    """Where weights are looked for when no place is given: ``~/.cache/ssrvlad/weights``."""
    return Path.home() / ".cache" / "ssrvlad" / "weights"


def find_weights(given: str | Path | None, names: Sequence[str], origin: str) -> Path:
    """The file of a method's weights; a FileNotFoundError names the files, the origin and the
    place.

    Args:
        given: a file of any name, or a folder to look in; None for `weights_folder`.
        names: published file names, relative to the folder, the first that exists wins.
        origin: who publishes them, for the message.
    """
    place = weights_folder() if given is None else Path(given).expanduser()
    wanted = [place / name for name in names] if given is None or place.is_dir() else [place]
    for path in wanted:
        if path.is_file():
            return path
    raise FileNotFoundError(
        f"no weights at {place}: expected {' or '.join(names)}, published by {origin}; "
        f"put it into {weights_folder()}, or name the file or its folder"
    )


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a PyTorch checkpoint, bare or under ``state_dict``; anything else is a
    ValueError.

    Only tensors, plain containers and NumPy numbers are unpickled, never code. The ``module.`` that
    ``nn.DataParallel`` puts into names is taken out.
    """
    try:
        with torch.serialization.safe_globals(_numpy_numbers()):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises nearly anything for damaged bytes
        if isinstance(error, OSError) and error.errno is not None:
            raise
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path} is not a whole PyTorch checkpoint: {reason}") from error
    state = content.get("state_dict", content) if isinstance(content, dict) else {}
    tensors = {
        str(name).replace("module.", ""): value
        for name, value in (state.items() if isinstance(state, dict) else ())
        if isinstance(value, Tensor)
    }
    if not tensors:
        raise ValueError(f"{path} must hold tensors by name, bare or under state_dict; it has none")
    return tensors


def fill(network: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Gives a network its weights, and ignores those that it does not have. The network may be on
    the device ``meta``, so that it needs no memory of its own.

    Raises:
        ValueError: a tensor is missing, has another shape, or is not finite.
    """
    wanted = network.state_dict()
    for name, tensor in wanted.items():
        got = state.get(name)
        if got is None:
            has = ", ".join(list(state)[:3])
            raise ValueError(f"{path} lacks {name} {tuple(tensor.shape)}; it has {has}, ...")
        if got.shape != tensor.shape:
            raise ValueError(
                f"{path}: {name} must be {tuple(tensor.shape)}, got {tuple(got.shape)}"
            )
        if not bool(got.isfinite().all()):
            raise ValueError(f"{path}: {name} holds values that are not finite")
    taken = {name: state[name].to(tensor.dtype) for name, tensor in wanted.items()}
    network.load_state_dict(taken, assign=True)


def random_network(make: Callable[[], Network]) -> Network:
    """A network with random weights, the same ones every time: it costs what a trained one costs.

    The random numbers of the caller stay as they are.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return make().eval()


def _numpy_numbers() -> list[Any]:
    """What a pickled NumPy number refers to, under NumPy's old and new module names."""
    scalar = np.float64(0).__reduce__()[0]
    kinds = [type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int32, np.int64, bool)]
    old, new = ((scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core"))
    return [np.dtype, *kinds, old, new]
