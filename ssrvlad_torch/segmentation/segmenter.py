"""Segmenting: images -> label maps, by any PyTorch module or any ONNX graph."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
import yaml
from PIL import Image
from torch import Tensor, nn

from ..datasets.frame_files import FrameFile, one_line, read_ahead
from ..datasets.image_files import Pixels, decode_image, image_bytes
from ..datasets.label_files import LabelMap, read_label_map
from ..files import replacing
from ..taxonomy import LabelSpace, label_space
from .network_outputs import choose_output, label_map, take_output
from .onnx_network import OnnxNetwork

PIXELS_AT_ONCE = 1 << 21
"""Pixels of a batch that the network is given, of one image at least."""

REVISION = 1
"""Raised whenever the same network and settings would give other label maps; part of every key."""

_AHEAD = 16
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_STD = (0.229, 0.224, 0.225)
_BYTES = {"white": 255, "mean": (0, 0, 0), "std": (1, 1, 1)}


@dataclass(frozen=True)
class SegmenterConfig:
    """What a network wants its images to be. The defaults are those of torchvision, transformers
    and segmentation-models-pytorch: ImageNet statistics, RGB.

    Attributes:
        size: height and width that every image is resized to (bilinear, antialiased, the aspect
            not kept); ``None`` leaves each at its own, or is the size that an ONNX graph fixes.
        white: the number for the brightest pixel: 1, or 255 for networks that count in bytes.
        mean, std: subtracted, then divided by, in the network's order of colours.
        colour_order: ``"rgb"`` or ``"bgr"``.
        output: name of the output to take, where a network has several that would do.

    Raises:
        ValueError: a setting is outside its range; the message names it and what was got.
    """

    size: tuple[int, int] | None = None
    white: float = 1.0
    mean: tuple[float, float, float] = _IMAGENET_MEAN
    std: tuple[float, float, float] = _IMAGENET_STD
    colour_order: str = "rgb"
    output: str | None = None

    def __post_init__(self) -> None:
        if self.size is not None and not _are_numbers(self.size, 2, int, above=0):
            raise ValueError(f"size must be height and width in pixels, got {self.size!r}")
        if not _are_numbers((self.white,), 1, (int, float), above=0):
            raise ValueError(f"white must be a number above 0, got {self.white!r}")
        if not _are_numbers(self.mean, 3, (int, float)):
            raise ValueError(f"mean must be three numbers, got {self.mean!r}")
        if not _are_numbers(self.std, 3, (int, float), above=0):
            raise ValueError(f"std must be three numbers above 0, got {self.std!r}")
        if self.colour_order not in ("rgb", "bgr"):
            raise ValueError(f"colour_order must be rgb or bgr, got {self.colour_order!r}")
        if not isinstance(self.output, str | None):
            raise ValueError(f"output must be a name, got {self.output!r}")


class _Prepared(NamedTuple):
    """An ``(h, w, 3)`` uint8 image of the network's size, the size that its label map is to have,
    and the file that is to keep it, if any."""

    pixels: Pixels
    size: tuple[int, int]
    entry: Path | None


class Segmenter:
    """Images -> label maps, each at the size of its image.

    The network's output is recognised by its shape (see `choose_output`), be it a tensor
    (segmentation-models-pytorch), in a mapping (torchvision), in an object with ``logits``
    (transformers) or in a tuple: class scores at any stride, or integer ids. It is enlarged to
    the size of the image, not of the network's input (see `label_map`).

    Args:
        network: any module that takes ``(B, 3, H, W)`` floats; it is put into evaluation mode
            and runs where its weights lie. `OnnxNetwork` is such a module.
        labels_as: label space of its classes.
        config: how its images are prepared.
        cache: folder in which `label_maps` keeps label maps, so that each is made once. A label
            map is found by the content of the image file, the settings, and the network: of an
            ONNX graph its files; of a module its text form, the code of its classes, weights and
            buffers, but not the functions that it calls.

    Raises:
        ValueError: the settings or the label space do not fit the ONNX graph.
        ImportError: a missing extra.

    Example:
        >>> segmenter = Segmenter(nn.Conv2d(3, 19, 1), "cityscapes-trainids")
        >>> (labels,) = segmenter([np.zeros((240, 320, 3), np.uint8)])
        >>> labels.shape
        (240, 320)
    """

    def __init__(
        self,
        network: nn.Module,
        labels_as: str,
        config: SegmenterConfig | None = None,
        cache: Path | None = None,
    ) -> None:
        self.network = network.eval()
        self.label_space = label_space(labels_as)
        self.config = config or SegmenterConfig()
        self.cache = cache
        self._forward: Callable[[Tensor], object] = network
        if isinstance(network, OnnxNetwork):
            try:
                self.config = _fitted(self.config, network, self.label_space)
            except ValueError as error:
                raise ValueError(f"{network.path}: {error}") from error
            self._forward = partial(network, names=[self.config.output])

    @classmethod
    def load(cls, path: str | Path, labels_as: str, cache: Path | None = None) -> Segmenter:
        """A segmenter from an ``.onnx`` file, or from a ``.yaml`` file that names one.

        The YAML file holds ``network``, a path relative to its folder, and what settings of
        `SegmenterConfig` differ from their defaults.

        Raises:
            ValueError: the files are missing or damaged, or do not fit the label space.
            ImportError: the extra ``onnx`` is not installed.
        """
        path, config = Path(path), SegmenterConfig()
        if path.suffix.lower() in (".yaml", ".yml"):
            path, config = _read_config(path)
        return cls(OnnxNetwork(path), labels_as, config, cache)

    def __call__(self, images: Sequence[Pixels]) -> list[LabelMap]:
        """The label maps of images in memory, past the cache.

        Args:
            images: each ``(H, W, 3)`` uint8 in RGB, of any size.

        Returns:
            ``(H, W)`` label maps: uint8, or uint16 or int64 if ids want it.

        Raises:
            ValueError: an image is of another form, the network fails, its output is not
                recognised or holds NaN scores.
        """
        for image in images:
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
                raise ValueError(f"wanted (H, W, 3) uint8 images, got {image.shape} {image.dtype}")
        results = self._complete([self._prepared(image) for image in images])
        for result in results:
            if isinstance(result, ValueError):
                raise result
        return [result for result in results if not isinstance(result, ValueError)]

    def label_maps(
        self,
        files: Sequence[FrameFile],
        workers: int = 2,
        progress: Callable[[int], None] | None = None,
    ) -> Iterator[tuple[FrameFile, LabelMap | ValueError]]:
        """The label maps of images on disk, in order; an error in place of one that has none.

        Args:
            files: from `find_image_files`.
            workers: threads that read and decode ahead of the network.
            progress: called with the number of frames done since the last call.

        Raises:
            ValueError: the network's output is not recognised.
            OSError: the cache cannot be written.
        """
        read = partial(self._read, self._folder())
        prepared = read_ahead(read, files, workers, _AHEAD)
        while chunk := list(islice(prepared, _AHEAD)):
            results = self._complete([content for _, content in chunk])
            for (file, _), result in zip(chunk, results, strict=True):
                if progress:
                    progress(1)
                yield file, result

    def _folder(self) -> Path | None:
        """Where the cache keeps what this network makes with these settings."""
        if self.cache is None:
            return None
        counts = self.label_space.channel_counts
        key = [REVISION, _digest(self.network), dataclasses.astuple(self.config), list(counts)]
        return self.cache / hashlib.blake2b(json.dumps(key).encode(), digest_size=16).hexdigest()

    def _read(self, folder: Path | None, file: FrameFile) -> LabelMap | _Prepared:
        content = image_bytes(file)
        entry = None
        if folder is not None:
            name = hashlib.blake2b(content, digest_size=16).hexdigest()
            entry = folder / name[:2] / f"{name}.png"
            labels = _kept(entry, self.label_space)
            if labels is not None:
                return labels
        return self._prepared(decode_image(content), entry)

    def _prepared(self, image: Pixels, entry: Path | None = None) -> _Prepared:
        pixels, size = image, self.config.size
        if size not in (None, image.shape[:2]):
            resized = Image.fromarray(image).resize(size[::-1], Image.Resampling.BILINEAR)
            pixels = np.asarray(resized)
        return _Prepared(pixels, (image.shape[0], image.shape[1]), entry)

    def _complete(
        self, chunk: Sequence[LabelMap | _Prepared | ValueError]
    ) -> list[LabelMap | ValueError]:
        """Puts label maps in the place of images, those of like size in one batch."""
        results = {p: item for p, item in enumerate(chunk) if not isinstance(item, _Prepared)}
        alike: dict[tuple[int, ...], list[tuple[int, _Prepared]]] = {}
        for place, item in enumerate(chunk):
            if isinstance(item, _Prepared):
                alike.setdefault(item.pixels.shape, []).append((place, item))
        for (height, width, _), members in alike.items():
            step = max(1, PIXELS_AT_ONCE // (height * width))
            for first in range(0, len(members), step):
                places, images = zip(*members[first : first + step], strict=True)
                results.update(zip(places, self._segment(images), strict=True))
        return [results[place] for place in range(len(chunk))]

    def _segment(self, images: Sequence[_Prepared]) -> list[LabelMap | ValueError]:
        """The label maps of a batch; where the network fails, each image is tried alone."""
        try:
            with torch.inference_mode():
                result = self._forward(self._batch(images))
        except Exception as error:  # what networks raise has no bounds
            if len(images) > 1:
                return [labels for image in images for labels in self._segment([image])]
            height, width, _ = images[0].pixels.shape
            return [ValueError(f"the network fails at {height}x{width}: {one_line(error)}")]
        channels_last = isinstance(self.network, OnnxNetwork) and self.network.channels_last
        output = take_output(result, self.label_space, self.config.output, channels_last)
        if len(output) != len(images):
            raise ValueError(f"the network gives {len(output)} outputs for {len(images)} images")
        return [_labels(one, image) for one, image in zip(output, images, strict=True)]

    def _batch(self, images: Sequence[_Prepared]) -> Tensor:
        """``(B, 3, h, w)`` numbers as the network wants them, where its weights lie."""
        config = self.config
        weights = chain(self.network.parameters(), self.network.buffers())
        like = next((tensor for tensor in weights if tensor.is_floating_point()), torch.empty(0))
        pixels = torch.from_numpy(np.stack([image.pixels for image in images])).to(like.device)
        if config.colour_order == "bgr":
            pixels = pixels.flip(-1)
        mean, std = (torch.tensor(v, device=like.device) for v in (config.mean, config.std))
        numbers = (pixels * (config.white / 255) - mean) / std
        return numbers.permute(0, 3, 1, 2).to(like.dtype).contiguous()


def _labels(output: Tensor, image: _Prepared) -> LabelMap | ValueError:
    try:
        labels = label_map(output, image.size)
    except ValueError as error:
        return error
    if image.entry is not None:
        _keep(labels, image.entry)
    return labels


def _kept(entry: Path, space: LabelSpace) -> LabelMap | None:
    """A label map of the cache; ``None`` if it is not there or damaged, to be made anew."""
    try:
        return read_label_map(FrameFile("cache", entry.stem, entry), space)
    except ValueError:
        return None


def _keep(labels: LabelMap, entry: Path) -> None:
    """Puts a label map into the cache, unless its ids are such as no PNG can hold."""
    if labels.dtype.itemsize > 2:
        return
    entry.parent.mkdir(parents=True, exist_ok=True)
    with replacing(entry) as temporary:
        Image.fromarray(labels).save(temporary, format="PNG", compress_level=1)


def _fitted(config: SegmenterConfig, network: OnnxNetwork, space: LabelSpace) -> SegmenterConfig:
    """The settings completed by what a graph declares: the size that it fixes, and the output."""
    for name, value in _BYTES.items() if network.takes_bytes else ():
        if getattr(config, name) != value:
            raise ValueError(f"takes bytes: wanted {name} {value}, got {getattr(config, name)}")
    output = choose_output(network.outputs, space, config.output)
    return dataclasses.replace(config, size=_fitted_size(config.size, network.size), output=output)


def _fitted_size(
    size: tuple[int, int] | None, fixed: tuple[int | None, int | None]
) -> tuple[int, int] | None:
    if size is None:
        if None not in fixed or fixed == (None, None):
            return cast(tuple[int, int] | None, fixed if fixed[0] else None)
        raise ValueError(f"takes images of {_by(fixed)}; wanted a size among the settings")
    if any(wanted not in (None, given) for given, wanted in zip(size, fixed, strict=True)):
        raise ValueError(f"takes images of {_by(fixed)}, the settings say {_by(size)}")
    return size


def _by(size: Sequence[int | None]) -> str:
    return "x".join("any" if length is None else str(length) for length in size)


def _read_config(path: Path) -> tuple[Path, SegmenterConfig]:
    """The network's path and its settings from a YAML file."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"cannot read the settings {path}: {one_line(error)}") from error
    if not isinstance(document, dict) or not isinstance(document.get("network"), str):
        raise ValueError(f"{path} names no network; wanted network: FILE.onnx, and settings")
    network = path.parent / document.pop("network")
    known = [field.name for field in dataclasses.fields(SegmenterConfig)]
    unknown = [name for name in document if name not in known]
    if unknown:
        raise ValueError(f"{path}: unknown setting {unknown[0]!r}; wanted {', '.join(known)}")
    settings: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in document.items()
    }
    try:
        return network, SegmenterConfig(**settings)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _digest(network: nn.Module) -> str:
    """BLAKE2b-128 of a network: of a graph its files; of a module its text, code and tensors."""
    if isinstance(network, OnnxNetwork):
        return network.digest()
    kinds = sorted({type(module) for module in network.modules()}, key=str)
    text = [str(network), *map(_source, kinds)]
    content = hashlib.blake2b("\n".join(text).encode(), digest_size=16)
    for name, tensor in chain(network.named_parameters(), network.named_buffers()):
        content.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        content.update(flat.view(torch.uint8).numpy().tobytes())
    return content.hexdigest()


def _source(kind: type) -> str:
    try:
        return inspect.getsource(kind)
    except (OSError, TypeError):  # it was typed at a prompt
        return str(kind)


def _are_numbers(values: object, count: int, kind: Any, above: float = float("-inf")) -> bool:
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(isinstance(v, kind) and not isinstance(v, bool) for v in values)
        and all(above < v < float("inf") for v in values)
    )
