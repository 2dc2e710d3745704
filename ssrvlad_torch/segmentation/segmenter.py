"""Segmenting: pictures -> label maps, by any PyTorch module or any ONNX graph."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import Pixels, decode_image
from ..datasets.label_files import LabelMap
from ..datasets.names import absolute
from ..files import check_pixels, one_line
from ..taxonomy import LabelSpace, label_space
from .activations import Activation, all_activations
from .cache import SegmentedCache
from .class_names import label_space_of_names
from .features import NetworkFeatures, probed
from .label_network import LabelNetwork
from .network_outputs import UnrecognisedError, channel_counts, classes_of, enlarged
from .networks import AUTO, NamedNetwork, open_network
from .onnx_network import OnnxNetwork
from .preparation import OF_SIDES, SegmenterConfig

PIXELS_AT_ONCE = 1 << 21
"""Most pixels of a batch for the network, which has at least one image."""

REVISION = 2
"""Increased whenever the same network and settings give other label maps; part of every key."""

_AHEAD = 16


class Segmented(NamedTuple):
    """The result of a network for a picture: an ``(H, W)`` label map, uint8, or uint16 or int64 for
    ids that need it, and, if asked for, features, uint8 signs of `stages.features.SHAPE`."""

    labels: LabelMap
    features: npt.NDArray[np.uint8] | None = None


class _Picture(NamedTuple):
    """An ``(H, W, 3)`` uint8 picture, and the digest of its file if its label map is cached."""

    pixels: Pixels
    digest: str = ""


class Segmenter:
    """Pictures -> label maps, each at the size of its picture.

    The network's output is recognised by its shape (`choose_output`): class scores at any stride,
    or integer ids, as a tensor, a mapping, an object with ``logits`` or a tuple. The class of a
    pixel is decided at the network's own stride, and the label map is resized to the picture
    (`enlarged`).

    Args:
        network: a module that takes ``(B, 3, H, W)`` floats, no TorchScript, or an `OnnxNetwork`.
            It is put into evaluation mode, runs on the device of its weights, and must stay as is.
        labels_as: label space of its classes.
        config: the preparation of its pictures, such as that of another segmenter.
        cache: folder in which `segmented` stores its results, by the content of the image file, the
            settings and the digest of the network (`digest_of`).
        name: of the network for `load`, if it has one.
        settings: fields of `SegmenterConfig` in place of those of ``config``.

    Raises:
        ValueError: a setting is unknown or outside its range, or does not fit the ONNX graph; the
            network is TorchScript.
        ImportError: an extra is not installed.

    Examples:
        >>> import numpy as np
        >>> from torch import nn
        >>> from ssrvlad_torch import Segmenter
        >>> network = nn.Conv2d(3, 19, 1)
        >>> segmenter = Segmenter(network, "cityscapes-trainids", size=512, colour_order="bgr")
        >>> segmenter([np.zeros((240, 320, 3), np.uint8)])[0].shape
        (240, 320)
    """

    def __init__(
        self,
        network: nn.Module,
        labels_as: str | os.PathLike[str] | LabelSpace,
        config: SegmenterConfig | None = None,
        cache: Path | None = None,
        *,
        name: str = "",
        **settings: Any,
    ) -> None:
        self.label_space = space = label_space(labels_as)
        defaults = vars(config) if config else {}
        self.labels = LabelNetwork(network, space, SegmenterConfig.of({**defaults, **settings}))
        self.cache, self.name, self.state = cache, name, ""
        self._caches = dict[tuple[Path, str, str], SegmentedCache]()

    def __getstate__(self) -> dict[str, object]:
        """Pickles no features: the session of a graph, which gives them, is not pickled either."""
        return {name: value for name, value in self.__dict__.items() if name != "features"}

    @property
    def network(self) -> nn.Module:
        """The network alone."""
        return self.labels.network

    @property
    def config(self) -> SegmenterConfig:
        """The preparation of pictures, with the size that an ONNX graph requires."""
        return self.labels.config

    @classmethod
    def load(
        cls,
        name: str | Path | NamedNetwork,
        labels_as: str | os.PathLike[str] | LabelSpace = AUTO,
        cache: Path | None = None,
    ) -> Segmenter:
        """A segmenter by the name of its network, or by what `open_network` gives. ``labels_as`` is
        the label space of its classes; ``"auto"`` is that of the YAML file, or of the network's
        class names (`label_space_of_names`). Errors are those of `open_network`; no label space is
        a ValueError."""
        if not isinstance(name, str | os.PathLike | NamedNetwork):
            raise ValueError(
                f"network: expected its name, its file or a Segmenter, got {type(name).__name__}"
            )
        named = name if isinstance(name, NamedNetwork) else open_network(name)
        if not isinstance(labels_as, LabelSpace):
            labels_as = space_of(named, str(labels_as))
        path = Path(named.name.removeprefix("hf:"))
        name = absolute(path) if path.exists() else named.name  # valid in any folder
        segmenter = cls(named.network, labels_as, named.config, cache, name=name)
        segmenter.state = named.state
        return segmenter

    @cached_property
    def features(self) -> NetworkFeatures:
        """The features of the network; if it has none, see `find_activations`, a ValueError."""
        try:
            return NetworkFeatures(self.labels, self._digest)
        except UnrecognisedError:
            raise
        except ValueError as error:
            raise ValueError(f"{self.name or 'the network'}: {error}") from error

    @property
    def fingerprint_of_features(self) -> str:
        """Under which a database stores the features; errors as of `features`."""
        return self.features.fingerprint

    @property
    def problem_of_features(self) -> str:
        """Why the rule finds no features, or nothing; a setting that names none is a ValueError."""
        try:
            _ = self.features
        except ValueError as error:
            if self.config.features or isinstance(error, UnrecognisedError):
                raise
            return str(error)
        return ""

    @torch.inference_mode()
    def activations(self) -> list[Activation]:
        """The activations for one picture that can be `features` by their names, in order."""
        activations = all_activations(self.network, probed(self.labels)[0])
        return [act for act in activations if math.isfinite(act.stride)]

    def __call__(self, images: Sequence[Pixels]) -> list[LabelMap]:
        """The label maps of pictures in memory, without the cache; see `segment`."""
        return [segmented.labels for segmented in self.segment(images)]

    def segment(self, images: Sequence[Pixels], features: bool = False) -> list[Segmented]:
        """The results of the network for pictures in memory, ``(H, W, 3)`` uint8 in RGB, of any
        size, with ``features`` also these. Another input, a network that fails, an output that is
        not recognised or holds NaN scores, and missing features are a ValueError."""
        for image in images:
            if not isinstance(image, np.ndarray):
                raise ValueError(f"expected arrays (H, W, 3) of uint8, got {type(image).__name__}")
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
                raise ValueError(
                    f"expected a list of (H, W, 3) uint8 images, got {image.shape} {image.dtype}"
                )
        extractor = self.features if features else None
        segmented = []
        for result in self._complete([*map(_Picture, images)], None, extractor):
            if isinstance(result, ValueError):
                raise result
            segmented.append(result)
        return segmented

    def label_maps(
        self, files: Sequence[FrameFile]
    ) -> Iterator[tuple[FrameFile, LabelMap | ValueError]]:
        """The label maps of images on disk; see `segmented`."""
        for file, result in self.segmented(files):
            yield file, result if isinstance(result, ValueError) else result.labels

    def segmented(
        self, files: Sequence[FrameFile], workers: int = 2, features: bool = False
    ) -> Iterator[tuple[FrameFile, Segmented | ValueError]]:
        """The results of the network for images on disk, in order, by threads that read ahead, with
        ``features`` also these; an error for an image that fails. An output that is not recognised,
        and missing features, are a ValueError; a cache that cannot be written is an OSError."""
        extractor, cache = self.features if features else None, None
        if self.cache is not None:
            of = self.cache, self.key(), extractor.key if extractor else ""
            cache = self._caches.setdefault(of, SegmentedCache(*of))

        def read(file: FrameFile) -> Segmented | _Picture:
            content = file.read()
            if cache is None:
                return _Picture(decode_image(content))
            digest = hashlib.blake2b(content, digest_size=16).hexdigest()
            stored = cache.get(digest)
            return Segmented(*stored) if stored else _Picture(decode_image(content), digest)

        ahead = read_ahead(read, files, workers, _AHEAD)
        while chunk := list(islice(ahead, _AHEAD)):
            results = self._complete([content for _, content in chunk], cache, extractor)
            yield from zip((file for file, _ in chunk), results, strict=True)

    def key(self) -> str:
        """The key in the cache, in hex; other networks and settings have other keys."""
        settings = dataclasses.astuple(dataclasses.replace(self.config, features=None))[:-1]
        key = [REVISION, self._digest, settings]
        key.append(list(channel_counts(self.label_space, self.config.classes))[:2])
        return hashlib.blake2b(json.dumps(key).encode(), digest_size=16).hexdigest()

    @cached_property
    def _digest(self) -> str:
        return digest_of(self.network)

    def _complete(
        self,
        chunk: Sequence[Segmented | _Picture | ValueError],
        cache: SegmentedCache | None,
        features: NetworkFeatures | None,
    ) -> list[Segmented | ValueError]:
        """Replaces pictures by their label maps and features; pictures of one size form batches."""
        results = {i: item for i, item in enumerate(chunk) if not isinstance(item, _Picture)}
        by_size: dict[tuple[int, ...], list[tuple[int, _Picture]]] = {}
        for i, item in enumerate(chunk):
            if isinstance(item, _Picture):
                by_size.setdefault(item.pixels.shape, []).append((i, item))
        for (height, width, _), members in by_size.items():
            fed = self.config.network_size(height, width)
            step = max(1, PIXELS_AT_ONCE // max(height * width, math.prod(fed)))
            for first in range(0, len(members), step):
                batch = members[first : first + step]
                segmented = self._segment([picture.pixels for _, picture in batch], features)
                for (i, picture), result in zip(batch, segmented, strict=True):
                    results[i] = result
                    if cache and picture.digest and not isinstance(result, ValueError):
                        cache.put(picture.digest, *result)
        return [results[i] for i in range(len(chunk))]

    @torch.inference_mode()
    def _segment(
        self, pictures: Sequence[Pixels], features: NetworkFeatures | None
    ) -> list[Segmented | ValueError]:
        """The results of a batch; if it fails, each picture is tried alone."""
        images = torch.from_numpy(np.stack(pictures))
        height, width = images.shape[1:3]
        try:
            check_pixels(*self.config.network_size(height, width))
            output, activations = self.labels.run(images, features.names if features else ())
            signs = features(activations).numpy(force=True) if features else None
        except UnrecognisedError:
            raise
        except Exception as error:  # networks raise many kinds of errors
            if len(pictures) > 1:
                alone = (self._segment([picture], features) for picture in pictures)
                return list(chain.from_iterable(alone))
            fed = self.config.network_size(height, width)
            at = f", fed at {fed[0]}x{fed[1]}" if fed != (height, width) else ""
            is_free = self.config.multiple == 1 and not isinstance(self.config.size, tuple)
            is_of_size = not isinstance(error, ValueError | torch.OutOfMemoryError)
            hint = f"; {OF_SIDES}" if is_free and is_of_size else ""
            failure = f"the network fails at {height}x{width}{at}: {one_line(error)}{hint}"
            return [ValueError(failure)]
        if len(output) != len(images):
            raise ValueError(f"the network gives {len(output)} outputs for {len(images)} images")
        results: list[Segmented | ValueError] = []
        for number, scores in enumerate(output.split(1)):
            try:
                labels = enlarged(classes_of(scores), height, width)[0].numpy(force=True)
            except ValueError as error:
                results.append(error)
                continue
            narrowest = np.min_scalar_type(labels.max())
            if labels.min() >= 0 and narrowest.itemsize <= 2:
                labels = labels.astype(narrowest)
            results.append(Segmented(labels, None if signs is None else signs[number]))
        return results


def space_of(network: NamedNetwork, labels_as: str = AUTO) -> LabelSpace:
    """The label space of a network's classes; a network that does not say it is a ValueError."""
    name = (network.labels_as or AUTO) if labels_as == AUTO else labels_as
    if name != AUTO:
        return label_space(name)
    if not network.class_names:
        raise ValueError(f"{network.name} does not name its classes; give --labels-as")
    first, last = network.config.classes or (0, max(network.class_names) + 1)
    names = {c - first: name for c, name in network.class_names.items() if first <= c < last}
    return label_space_of_names(names, network.name)


def digest_of(network: nn.Module) -> str:
    """A digest in hex: of an ONNX graph's files, or of a module's ``print`` and ``state_dict()``.
    Modules that differ in their code alone have one digest."""
    if isinstance(network, OnnxNetwork):
        return network.digest
    content = hashlib.blake2b(repr(network).encode(), digest_size=16)
    for name, tensor in network.state_dict().items():
        content.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        content.update(flat.view(torch.uint8).numpy())
    return content.hexdigest()
