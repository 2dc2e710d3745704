"""Segmenting: pictures -> label maps, by any PyTorch module or any ONNX graph."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..class_names import label_space_of_names
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import Pixels, decode_image
from ..datasets.label_files import LabelMap
from ..datasets.names import absolute
from ..files import one_line
from ..taxonomy import LabelSpace, label_space
from ..untrusted import check_pixels
from .cache import LARGEST, LabelMapCache
from .identity import digest_of
from .label_network import LabelNetwork
from .network_outputs import UnrecognisedError, channel_counts, classes_of, enlarged
from .networks import AUTO, NamedNetwork, open_network
from .onnx_network import OnnxNetwork
from .preparation import SegmenterConfig

PIXELS_AT_ONCE = 1 << 21
"""Pixels of a batch that the network is given, of one image at least."""

REVISION = 2
"""Raised whenever the same network and settings would give other label maps; part of every key."""

_AHEAD = 16


class _Picture(NamedTuple):
    """An ``(H, W, 3)`` uint8 picture, and the digest of its file if its label map is kept."""

    pixels: Pixels
    digest: str | None


class Segmenter:
    """Pictures -> label maps, each at the size of its picture.

    The network's output is recognised by its shape (see `choose_output`), be it a tensor
    (segmentation-models-pytorch), in a mapping (torchvision), in an object with ``logits``
    (transformers) or in a tuple: class scores at any stride, or integer ids. The class of a pixel
    is decided at the network's own stride (`classes_of`), and the label map is then brought to the
    size of the picture (`enlarged`).

    Args:
        network: any module that takes ``(B, 3, H, W)`` floats; it is put into evaluation mode and
            runs where its weights lie. `OnnxNetwork` is such a module.
        labels_as: label space of its classes.
        config: how its pictures are prepared.
        cache: folder in which `label_maps` keeps label maps, by the content of the image file, the
            settings, and the network as `digest_of` tells it from others.
        cache_bytes: most that the whole cache may hold.
        name: by which `load` finds the network again, if there is one.

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
        labels_as: str | os.PathLike[str] | LabelSpace,
        config: SegmenterConfig | None = None,
        cache: Path | None = None,
        cache_bytes: int = LARGEST,
        name: str = "",
    ) -> None:
        self.label_space = space = label_space(labels_as)
        self.labels = LabelNetwork(network, space, config or SegmenterConfig())
        self.cache, self.cache_bytes, self.name = cache, cache_bytes, name

    @property
    def network(self) -> nn.Module:
        """The network alone."""
        return self.labels.network

    @property
    def config(self) -> SegmenterConfig:
        """How pictures are prepared, completed by what an ONNX graph declares."""
        return self.labels.config

    @classmethod
    def load(
        cls,
        name: str | Path | NamedNetwork,
        labels_as: str | os.PathLike[str] | LabelSpace = AUTO,
        cache: Path | None = None,
        classes: tuple[int, int] | None = None,
    ) -> Segmenter:
        """A segmenter by the name of its network; see `open_network` for the names.

        Args:
            name: of the network, or what `open_network` made of it.
            labels_as: label space of its classes; ``"auto"`` takes what the YAML file says, or
                what the network's own class names mean (`label_space_of_names`).
            cache: as for `Segmenter`.
            classes: the channels to take, if not those of the YAML file.

        Raises:
            ValueError: the name means nothing, the network cannot be used, or it has no class
                names and no label space is given.
            OSError: the network cannot be downloaded.
            ImportError: a missing extra.
        """
        found = name if isinstance(name, NamedNetwork) else open_network(name)
        config = found.config
        if classes is not None:
            config = dataclasses.replace(config, classes=classes)
        space = (
            labels_as
            if isinstance(labels_as, LabelSpace)
            else _space(found, str(labels_as), config)
        )
        return cls(found.network, space, config, cache, name=_lasting(found.name))

    def __call__(self, images: Sequence[Pixels]) -> list[LabelMap]:
        """The label maps of pictures in memory, past the cache.

        Args:
            images: each ``(H, W, 3)`` uint8 in RGB, of any size.

        Returns:
            ``(H, W)`` label maps: uint8, or uint16 or int64 if ids want it.

        Raises:
            ValueError: a picture is of another form, the network fails, its output is not
                recognised or holds NaN scores.
        """
        for image in images:
            if not isinstance(image, np.ndarray):
                raise ValueError(f"expected arrays (H, W, 3) of uint8, got {type(image).__name__}")
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
                raise ValueError(
                    f"expected a list of (H, W, 3) uint8 images, got {image.shape} {image.dtype}"
                )
        results = []
        for result in self._complete([_Picture(image, None) for image in images], None):
            if isinstance(result, ValueError):
                raise result
            results.append(result)
        return results

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
        cache = None
        if self.cache is not None:
            cache = LabelMapCache(self.cache, self.key(), self.label_space, self.cache_bytes)
        read = read_ahead(partial(_read, cache), files, workers, _AHEAD)
        while chunk := list(islice(read, _AHEAD)):
            results = self._complete([content for _, content in chunk], cache)
            for (file, _), result in zip(chunk, results, strict=True):
                if progress:
                    progress(1)
                yield file, result

    def key(self) -> str:
        """A name for what the network makes with these settings; another network or other
        settings have another."""
        key = [REVISION, self._digest(), dataclasses.astuple(self.config)]
        key.append(list(channel_counts(self.label_space, self.config.classes))[:2])
        return hashlib.blake2b(json.dumps(key).encode(), digest_size=16).hexdigest()

    def _digest(self) -> str:
        probe = np.random.default_rng(0).integers(0, 256, (224, 448, 3), np.uint8)
        try:
            made = b"" if isinstance(self.network, OnnxNetwork) else self([probe])[0].tobytes()
        except ValueError:  # it takes no picture of this size
            made = b"none"
        return digest_of(self.network, made)

    def _complete(
        self, chunk: Sequence[LabelMap | _Picture | ValueError], cache: LabelMapCache | None
    ) -> list[LabelMap | ValueError]:
        """Puts label maps in the place of pictures, those of like size in one batch."""
        results = {p: item for p, item in enumerate(chunk) if not isinstance(item, _Picture)}
        alike: dict[tuple[int, ...], list[tuple[int, _Picture]]] = {}
        for place, item in enumerate(chunk):
            if isinstance(item, _Picture):
                alike.setdefault(item.pixels.shape, []).append((place, item))
        for (height, width, _), members in alike.items():
            given = self.config.network_size(height, width)
            step = max(1, PIXELS_AT_ONCE // max(height * width, given[0] * given[1]))
            for first in range(0, len(members), step):
                places, pictures = zip(*members[first : first + step], strict=True)
                labels = self._segment([picture.pixels for picture in pictures])
                results.update(zip(places, labels, strict=True))
                for picture, made in zip(pictures, labels, strict=True):
                    if cache and picture.digest and not isinstance(made, ValueError):
                        cache.put(picture.digest, made)
        return [results[place] for place in range(len(chunk))]

    @torch.inference_mode()
    def _segment(self, pictures: Sequence[Pixels]) -> list[LabelMap | ValueError]:
        """The label maps of a batch; where the network fails, each picture is tried alone."""
        images = self.labels.place(torch.from_numpy(np.stack(pictures)))
        try:
            check_pixels(*self.config.network_size(*images.shape[1:3]))
            output = self.labels.outputs(images)
        except UnrecognisedError:
            raise
        except Exception as error:  # what networks raise has no bounds
            if len(pictures) > 1:
                return [labels for picture in pictures for labels in self._segment([picture])]
            height, width, _ = pictures[0].shape
            return [ValueError(f"the network fails at {height}x{width}: {one_line(error)}")]
        if len(output) != len(images):
            raise ValueError(f"the network gives {len(output)} outputs for {len(images)} images")
        return [_label_map(one, *images.shape[1:3]) for one in output.split(1)]


def _label_map(output: Tensor, height: int, width: int) -> LabelMap | ValueError:
    try:
        return _narrowest(enlarged(classes_of(output), height, width)[0])
    except ValueError as error:
        return error


def _read(cache: LabelMapCache | None, file: FrameFile) -> LabelMap | _Picture:
    content = file.read()
    if cache is None:
        return _Picture(decode_image(content), None)
    digest = hashlib.blake2b(content, digest_size=16).hexdigest()
    labels = cache.get(digest)
    return _Picture(decode_image(content), digest) if labels is None else labels


def _narrowest(ids: Tensor) -> LabelMap:
    labels = ids.numpy(force=True)
    for dtype in (np.uint8, np.uint16):
        if labels.min() >= 0 and labels.max() <= np.iinfo(dtype).max:
            return labels.astype(dtype)
    return labels


def _space(found: NamedNetwork, labels_as: str, config: SegmenterConfig) -> LabelSpace:
    """The label space of a network's classes."""
    name = (found.labels_as or AUTO) if labels_as == AUTO else labels_as
    if name != AUTO:
        return label_space(name)
    if not found.class_names:
        raise ValueError(f"{found.name} does not say what its classes are; give --labels-as")
    first, last = config.classes or (0, max(found.class_names) + 1)
    names = {c - first: name for c, name in found.class_names.items() if first <= c < last}
    return label_space_of_names(names, found.name)


def _lasting(name: str) -> str:
    """The name of a network with an absolute path, valid in any folder."""
    path = Path(name.removeprefix("hf:"))
    return absolute(path) if path.exists() else name
