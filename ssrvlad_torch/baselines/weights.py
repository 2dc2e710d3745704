"""Weights on disk: finds the files, reads checkpoints, and loads them into networks. Nothing is
ever downloaded."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


def weights_folder() -> Path:
    """The default folder of weights: ``~/.cache/ssrvlad/weights``."""
    return Path.home() / ".cache" / "ssrvlad" / "weights"


def find_weights(weights: str | Path | None, names: Sequence[str], origin: str) -> Path:
    """The file of a method's weights: one of any name, or in a folder, by default
    `weights_folder`, the first published name that exists. A FileNotFoundError says what is
    missing and who has it."""
    path = weights_folder() if weights is None else Path(weights).expanduser()
    folder = weights is None or path.is_dir()
    for candidate in [path / name for name in names] if folder else [path]:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"no weights at {path}: expected {' or '.join(names)}, published by {origin}; "
        f"put it into {weights_folder()}, or name the file or its folder"
    )


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a PyTorch checkpoint, bare or under ``state_dict``; anything else is a
    ValueError. Only tensors, plain containers and NumPy numbers are unpickled, never code. The
    ``module.`` that ``nn.DataParallel`` adds to names is removed."""
    scalar = np.float64(0).__reduce__()[0]  # under NumPy's old and new modules
    numbers: list[Any] = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    kinds = (np.float32, np.float64, np.int32, np.int64, bool)
    numbers += [np.dtype, *(type(np.dtype(kind)) for kind in kinds)]
    try:
        with torch.serialization.safe_globals(numbers):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds of errors for damaged bytes
        if isinstance(error, OSError) and error.errno is not None:
            raise
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{path} is not a whole PyTorch checkpoint: {reason}") from error
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    tensors = {
        str(name).replace("module.", ""): value
        for name, value in (state if isinstance(state, dict) else {}).items()
        if isinstance(value, Tensor)
    }
    if not tensors:
        raise ValueError(f"{path} must hold tensors by name, bare or under state_dict; it has none")
    return tensors


def fill(network: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Loads weights into a network and ignores those that it does not have. The network may be on
    the device ``meta``, where it needs no memory. A tensor that is missing, has another shape or is
    not finite is a ValueError."""
    expected = network.state_dict()
    for name, tensor in expected.items():
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
    weights = {name: state[name].to(tensor.dtype) for name, tensor in expected.items()}
    network.load_state_dict(weights, assign=True)


def random_network(make: Callable[[], Network]) -> Network:
    """A network with random weights, the same every time, to measure costs. It does not change the
    random state of the caller."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return make().eval()
