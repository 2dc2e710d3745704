"""Networks by name: a graph, a YAML file, a published model, or a function that returns one."""

import dataclasses
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..files import InputError, naming, one_line, path_within, read_yaml, requiring
from .cache import YAML, state_of
from .onnx_network import ONNX_RUNTIME, RUNTIMES, OnnxNetwork
from .preparation import SegmenterConfig

AUTO = "auto"
"""The label space that the network's own class names define."""

ACCEPT = "accept_defaults"
"""The key of a YAML file that accepts the assumed preparation, so that it is not noted."""

_COLOURS = {"mean", "std", "white", "colour_order"}
"""With one of these settings the preparation counts as chosen, not assumed."""

_KEYS = ("network", "labels_as", "arguments", "runtime", ACCEPT)
"""Keys of a YAML file that are no settings of the preparation."""

_WEIGHTS = (".pth", ".pt", ".ckpt", ".bin", ".safetensors", ".pkl")
_MASK_NETWORKS = ("maskformer", "mask2former")
_WHERE = "FILE.onnx, FILE.yaml, hf:ORG/NAME[@REVISION], a folder, MODULE:NAME"


@dataclass(frozen=True)
class NamedNetwork:
    """A network by the name that `open_network` was given, the preparation of its pictures, which
    may be ``assumed``, the names of its channels and the label space, if it declares them, and the
    state of its files before it was opened, see `state_of`."""

    name: str
    network: nn.Module
    config: SegmenterConfig
    class_names: Mapping[int, str] = field(default_factory=dict)
    labels_as: str | None = None
    assumed: bool = False
    state: str = ""

    @property
    def assumption(self) -> str:
        """What is assumed of the preparation, in words; empty if nothing is."""
        c = self.config
        size = "the size of the graph or of the picture" if c.size is None else c.size
        return self.assumed * (
            f"{self.name} does not say how it wants pictures; assumed: {c.colour_order}, 0 to "
            f"{c.white:g}, mean {c.mean}, std {c.std}, size: {size} "
            f"({ACCEPT}: true in a YAML file accepts that)"
        )


def open_network(name: str | Path) -> NamedNetwork:
    """A network by its name: an ``.onnx`` file; a ``.yaml`` file; ``hf:ORG/NAME[@REVISION]`` of the
    Hugging Face hub, or a folder in that format (extra ``hf``); or ``MODULE:NAME``, a function that
    returns an `nn.Module`.

    A YAML file has ``network``, one of these names, settings of `SegmenterConfig`, and perhaps
    ``labels_as``, ``arguments`` for a function, ``runtime`` for an ONNX file, and
    ``accept_defaults``. Its files are in its folder or below. What is not understood or cannot be
    used is a ValueError, what cannot be downloaded an OSError, a missing extra an ImportError."""
    state, path = state_of(str(name)), Path(name)
    if path.suffix.lower() not in YAML:
        return dataclasses.replace(_open(str(name), {}), state=state)
    named, document = _named(path)
    labels_as, arguments = document.pop("labels_as", None), document.pop("arguments", {})
    accepted, runtime = document.pop(ACCEPT, False), document.pop("runtime", ONNX_RUNTIME)
    with naming(path):
        config = SegmenterConfig.of(document, _KEYS)
        if not isinstance(arguments, dict):
            raise ValueError(f"arguments must be names with values, got {arguments!r}")
        if not isinstance(accepted, bool):
            raise ValueError(f"{ACCEPT} must be true or false, got {accepted!r}")
        if runtime not in RUNTIMES:
            raise ValueError(f"runtime must be {' or '.join(RUNTIMES)}, got {runtime!r}")
        if labels_as and Path(str(labels_as)).suffix.lower() in YAML:
            labels_as = str(path_within(path.parent, labels_as))
    for key, value in arguments.items():
        with suppress(InputError):  # the user's code decides what else a value means
            if (file := path_within(path.parent, value)).exists():
                arguments[key] = str(file)
    settings = {key: getattr(config, key) for key in document}
    network = _open(named, settings, arguments, path.parent, runtime)
    if runtime != getattr(network.network, "runtime", ONNX_RUNTIME):
        raise ValueError(f"{path}: runtime: {runtime} is for ONNX files, got network: {named}")
    assumed = network.assumed and not accepted
    return dataclasses.replace(
        network, name=str(path), labels_as=labels_as, assumed=assumed, state=state
    )


def runs_code(name: str) -> bool:
    """Whether opening a network runs code; a YAML file that names none is a ValueError."""
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix in YAML and path.is_file():
        return runs_code(_named(path)[0])
    return not (suffix in (*YAML, ".onnx") or path.is_dir() or name.startswith("hf:"))


def _open(
    name: str,
    settings: dict[str, Any],
    arguments: Mapping[str, Any] | None = None,
    folder: Path | None = None,
    runtime: str = ONNX_RUNTIME,
) -> NamedNetwork:
    """A network by its name, which stands in a YAML file in a folder, or alone."""
    path, assumed = Path(name), not _COLOURS & settings.keys()
    suffix = path.suffix.lower()
    if suffix == ".onnx":
        graph = OnnxNetwork(path, runtime)
        names = graph.class_names()
        return NamedNetwork(name, graph, SegmenterConfig(**settings), names, assumed=assumed)
    if name.startswith("hf:") or path.is_dir():
        return _of_hub(name, settings)
    if suffix in _WEIGHTS:
        raise ValueError(
            f"{name} can only be the weights of a network; expected MODULE:NAME, a function in "
            "Python that makes the network and loads them"
        )
    network = _made(name, arguments or {}, folder)
    return NamedNetwork(name, network, SegmenterConfig(**settings), assumed=assumed)


def _named(path: Path) -> tuple[str, dict[str, Any]]:
    """The name of the network in a YAML file, and the other entries."""
    try:
        document = read_yaml(path)
    except OSError as error:
        raise ValueError(f"cannot read the settings {path}: {one_line(error)}") from error
    if not isinstance(document, dict) or not isinstance(document.get("network"), str):
        raise ValueError(f"{path} names no network; expected network: NAME, and settings")
    name = document.pop("network")
    if Path(name).suffix.lower() in YAML:
        raise ValueError(
            f"{path}: network: expected a network, got another file of settings, {name}"
        )
    if name.startswith((".", "/")) or (path.parent / name).exists() or name.endswith(".onnx"):
        with naming(path):
            name = str(path_within(path.parent, name))
    return name, document


def _made(name: str, arguments: Mapping[str, Any], folder: Path | None) -> nn.Module:
    """The network that the function ``MODULE:NAME`` returns, of a module beside the YAML file,
    here, or on the path; an error of the function names its arguments."""
    module, _, function = name.partition(":")
    places = [str(place.absolute()) for place in (folder, Path()) if place is not None]
    if not function:
        raise ValueError(f"no network {name!r}; expected {_WHERE}")
    sys.path[:0] = places
    try:
        with _no_exit():
            loaded = import_module(module)
        make = getattr(loaded, function)
    except Exception as error:  # a user's code
        raise ValueError(f"no network {name!r}: {one_line(error)}; expected {_WHERE}") from error
    finally:
        del sys.path[: len(places)]
    file, beside = getattr(loaded, "__file__", None), Path(places[0], f"{module}.py")
    if file and beside.is_file() and beside.resolve() != Path(file).resolve():
        raise ValueError(f"another module {module} is loaded already, {file}; rename {beside}")
    try:
        with _no_exit():
            network = make(**arguments)
    except Exception as error:  # a user's code
        values = ", ".join(f"{key}: {value}" for key, value in arguments.items())
        raise ValueError(f"{name}({values}) fails: {_reason(error)}") from error
    if not isinstance(network, nn.Module):
        raise ValueError(f"{name} gives a {type(network).__name__}; expected an nn.Module")
    return network


@contextmanager
def _no_exit() -> Iterator[None]:
    """Turns a ``sys.exit`` of a user's code into an error, but not that of SIGTERM."""
    try:
        yield
    except SystemExit as end:
        if end.code == 128 + signal.SIGTERM:
            raise
        raise RuntimeError(f"it calls sys.exit({end.code!r})") from end


def _reason(error: Exception) -> str:
    """An error in one line, with the file that is missing or cannot be read."""
    file = getattr(error, "filename", None)
    return f"{file}: {one_line(error)}" if file else one_line(error)


class MaskScores(nn.Module):
    """Class scores of a network of the MaskFormer family, which gives masks, each with the scores
    of its class."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """``(B, C, h, w)``: each mask gives its pixels the scores of its class."""
        output = self.network(pixel_values=images)
        classes = output.class_queries_logits.softmax(-1)[..., :-1]
        masks = output.masks_queries_logits.sigmoid()
        return torch.einsum("bqc,bqhw->bchw", classes, masks)


def _of_hub(name: str, settings: dict[str, Any]) -> NamedNetwork:
    """A published model, or a folder in that format, with the settings of its image processor."""
    with requiring("hf", f"{name} needs"):
        import transformers as hub
    source, _, revision = name.removeprefix("hf:").partition("@")
    pinned = {"revision": revision} if revision else {}
    if not sys.stderr.isatty():
        hub.utils.logging.disable_progress_bar()
    try:
        config = hub.AutoConfig.from_pretrained(source, **pinned)
        has_masks = config.model_type in _MASK_NETWORKS
        family = "Universal" if has_masks else "Semantic"
        network = getattr(hub, f"AutoModelFor{family}Segmentation").from_pretrained(
            source, **pinned
        )
        processor = hub.AutoImageProcessor.from_pretrained(source, backend="pil", **pinned)
    except OSError as error:
        reason = _reason(error).partition(" Check your internet")[0]
        raise OSError(f"{name} cannot be loaded: {reason}") from error
    except Exception as error:  # the libraries raise many kinds of errors
        raise ValueError(f"{name} cannot be used: {one_line(error)}") from error
    if has_masks:
        network = MaskScores(network)
    with naming(name):
        settings = _settings_of(processor, settings)
    return NamedNetwork(name, network, SegmenterConfig(**settings), dict(config.id2label))


def _settings_of(processor: Any, overrides: dict[str, Any]) -> dict[str, Any]:
    """The settings of an image processor, or a ValueError for a step that is no setting."""
    settings: dict[str, Any] = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
    if processor.do_normalize:
        settings |= {"mean": tuple(processor.image_mean), "std": tuple(processor.image_std)}
    settings["white"] = 255 * (processor.rescale_factor if processor.do_rescale else 1)
    if "size" in overrides:
        return settings | overrides
    if getattr(processor, "do_center_crop", False):
        raise ValueError("its image processor cuts off the borders; give a size in a YAML file")
    divisor = getattr(processor, "size_divisor", None) or 1
    if processor.do_resize:
        size = processor.size
        if size.height and size.width:
            sides = size.height, size.width
            keeps_aspect = getattr(processor, "keep_aspect_ratio", False)
            settings["size"] = min(sides) if keeps_aspect else sides
            divisor = getattr(processor, "ensure_multiple_of", None) or divisor
        elif size.shortest_edge:
            settings |= {"size": size.shortest_edge, "longest": size.longest_edge}
        else:
            raise ValueError(f"its image processor resizes to {size}; give a size in a YAML file")
    return settings | {"multiple": divisor} | overrides
