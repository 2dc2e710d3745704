"""Published weights on disk: finds the files, and fills networks. Nothing is downloaded, and of a
file no code is run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor, nn

from ..files import naming


def weights_folder() -> Path:
    """The default folder of weights: ``~/.cache/ssrvlad/weights``."""
    return Path.home() / ".cache" / "ssrvlad" / "weights"


def find_weights(weights: str | Path | None, names: Sequence[str], origin: str) -> Path:
    """The file of a method's weights, or in a folder, by default `weights_folder`, the first
    published name. A FileNotFoundError says what is missing and who has it."""
    path = weights_folder() if weights is None else Path(weights).expanduser()
    folder = weights is None or path.is_dir()
    for candidate in [path / name for name in names] if folder else [path]:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"no weights at {path}: expected {' or '.join(names)}, published by {origin}; "
        f"put it into {weights_folder()}, or name the file or its folder"
    )


def fill(network: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Loads weights into a network, which may be on ``meta``, and ignores others; a tensor that is
    missing or of another shape is a ValueError."""
    with naming(path):
        missing, _ = network.load_state_dict(state, strict=False, assign=True)
        if missing:
            raise ValueError(f"lacks {missing[0]}; it has {', '.join(list(state)[:3])}, ...")
    network.float()
