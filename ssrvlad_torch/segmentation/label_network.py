"""Pictures -> class scores or ids as one module: preparation, network, axis of the classes."""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import cast

import torch
from torch import Tensor, nn

from ..files import naming
from ..taxonomy import LabelSpace
from .activations import captured
from .network_outputs import (
    UnrecognisedError,
    batched,
    choose_output,
    classes_of,
    enlarged,
    scores_along,
    tensors_of,
)
from .onnx_network import OnnxNetwork
from .preparation import Preparation, SegmenterConfig


class LabelNetwork(nn.Module):
    """Pictures -> class scores or ids. `Segmenter` runs it, and `fuse` writes it as a graph.

    The network takes ``(B, 3, h, w)`` floats; ``config`` is the preparation, with the size that a
    graph requires. After the first run ``output`` is the name of the output that holds labels, and
    ``axis`` that of its classes, if it has one. Settings that do not fit a graph, and TorchScript,
    are a ValueError.
    """

    def __init__(self, network: nn.Module, space: LabelSpace, config: SegmenterConfig) -> None:
        super().__init__()
        if isinstance(network, OnnxNetwork):
            with naming(network.path):
                config = _completed(config, network)
        for part in nn.Module.modules(network):
            if isinstance(part, torch.jit.ScriptModule):
                raise ValueError(
                    "expected the module of which the TorchScript was made, got "
                    f"{type(part).__name__} {getattr(part, 'original_name', '')}"
                )
        self.network, self.space, self.config = network, space, config
        self.output: str | None = None
        self.axis: int | None = None
        self.preparation = Preparation(config)
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """The label maps ``(B, H, W)`` of pictures of one size."""
        return enlarged(classes_of(self.run(images)[0]), *images.shape[1:3])

    def run(self, images: Tensor, names: Sequence[str] = ()) -> tuple[Tensor, list[Tensor]]:
        """Class scores ``(B, C, h, w)`` or ids ``(B, h, w)`` of pictures ``(B, H, W, 3)`` uint8 in
        RGB, and the named activations, or a ValueError."""
        numbers, config = self.numbers(images), self.config
        graph = self.network if isinstance(self.network, OnnxNetwork) else None
        values: Mapping[str, Tensor]
        if graph:
            computed = graph.outputs if self.output is None else [self.output]
            values = graph(numbers, names=[*computed, *names])
            outputs = {name: values[name] for name in computed}
        else:
            with captured(self.network, names) as values:
                outputs = tensors_of(self.network(numbers))
        if missing := [name for name in names if name not in values]:
            raise ValueError(f"features: the network did not compute {missing[0]}")
        outputs = {name: batched(output, numbers) for name, output in outputs.items()}
        if self.output is None:
            last, size = graph is not None and graph.channels_last, numbers.shape[2:]
            named = config.output, config.classes
            try:
                chosen, self.axis = choose_output(outputs, self.space, size, last, *named)
            except UnrecognisedError as error:
                raise UnrecognisedError(f"{graph.path}: {error}" if graph else error) from error
            self.output = chosen
        scores = scores_along(outputs[self.output], self.axis, config.classes)
        return scores, [values[name] for name in names]

    def numbers(self, images: Tensor) -> Tensor:
        """The input of the network for pictures, on the device of its weights."""
        weights = chain(nn.Module.parameters(self.network), nn.Module.buffers(self.network))
        like = next((tensor for tensor in weights if tensor.is_floating_point()), None)
        if like is None:  # an ONNX graph, or a network without weights
            return cast(Tensor, self.preparation(images))
        return cast(Tensor, self.preparation(images.to(like.device))).to(like.dtype)


def _completed(config: SegmenterConfig, network: OnnxNetwork) -> SegmenterConfig:
    """The settings with the size that a graph requires."""
    if network.dtype == torch.uint8:
        for name, value in {"white": 255, "mean": (0, 0, 0), "std": (1, 1, 1)}.items():
            if (got := getattr(config, name)) != value:
                raise ValueError(f"takes bytes: expected {name} {value}, got {got}")
    size, required = config.size, network.size
    if required == (None, None):
        return config
    if size is None and None not in required:
        size = cast(tuple[int, int], required)
    if not isinstance(size, tuple):
        raise ValueError(f"takes images of {_by(required)}; expected a size among the settings")
    if any(expected not in (None, got) for got, expected in zip(size, required, strict=True)):
        raise ValueError(f"takes images of {_by(required)}, the settings say {_by(size)}")
    return dataclasses.replace(config, size=size)


def _by(size: Sequence[int | None]) -> str:
    return "x".join("any" if length is None else str(length) for length in size)
