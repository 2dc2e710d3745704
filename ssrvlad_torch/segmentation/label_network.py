"""Pictures -> class scores or ids as one module: preparation, network, axis of the classes."""

import dataclasses
from collections.abc import Sequence
from itertools import chain
from typing import cast

import torch
from torch import Tensor, nn

from ..files import naming
from ..taxonomy import LabelSpace
from .activations import captured
from .network_outputs import (
    choose_output,
    class_axis,
    classes_of,
    enlarged,
    form_of,
    tensors_of,
)
from .onnx_network import OnnxNetwork
from .preparation import Preparation, SegmenterConfig


class LabelNetwork(nn.Module):
    """Pictures -> class scores or ids, in which `classes_of` decides. `Segmenter` runs it, and
    `fuse` writes it as a graph.

    Args:
        network: any module that takes ``(B, 3, h, w)`` floats, or an `OnnxNetwork`.
        space: label space of its classes.
        config: the preparation of its pictures.

    Attributes:
        axis: the axis of the network's output that holds the classes, ``None`` if not yet known.

    Raises:
        ValueError: the settings or the label space do not fit an ONNX graph.
    """

    def __init__(self, network: nn.Module, space: LabelSpace, config: SegmenterConfig) -> None:
        super().__init__()
        self.network, self.space = network, space
        self.config, form = config, None
        self.axis: int | None = None
        if isinstance(network, OnnxNetwork):
            with naming(network.path):
                self.config, form = _completed(config, network, space), network.form
            declared = network.outputs[str(self.config.output)]
            if declared.shape and len(declared.shape) == 4:
                self.axis = class_axis(declared, space, self.config.classes)
        self.preparation = Preparation(self.config, form)
        self.eval()

    def forward(self, images: Tensor) -> Tensor:
        """The label maps ``(B, H, W)`` of pictures of one size."""
        return enlarged(classes_of(self.run(images)[0]), *images.shape[1:3])

    def run(self, images: Tensor, names: Sequence[str] = ()) -> tuple[Tensor, list[Tensor]]:
        """Class scores ``(B, C, h, w)`` or ids ``(B, h, w)`` of pictures ``(B, H, W, 3)`` uint8 in
        RGB, and the named activations, or a ValueError."""
        numbers = self.numbers(images)
        output, activations = self._output(numbers, names)
        return self.scores_of(output, numbers), activations

    def numbers(self, images: Tensor) -> Tensor:
        """The input of the network for pictures, on the device of its weights."""
        weights = chain(self.network.parameters(), self.network.buffers())
        like = next((tensor for tensor in weights if tensor.is_floating_point()), None)
        if like is None:  # an ONNX graph, or a network without weights
            return cast(Tensor, self.preparation(images))
        return cast(Tensor, self.preparation(images.to(like.device))).to(like.dtype)

    def scores_of(self, output: Tensor, numbers: Tensor) -> Tensor:
        """An output of the network for prepared pictures, with the classes in the second axis."""
        if output.ndim == 3:
            return output
        if self.axis is None:
            self.axis = self._axis_of(output, numbers)
        if not output.is_floating_point():
            return output.squeeze(self.axis)
        scores = output.movedim(self.axis, 1)
        return scores if self.config.classes is None else scores[:, slice(*self.config.classes)]

    def _output(self, numbers: Tensor, names: Sequence[str] = ()) -> tuple[Tensor, list[Tensor]]:
        config = self.config
        if isinstance(self.network, OnnxNetwork):
            values = self.network(numbers, names=[config.output, *names])
            outputs = {str(config.output): values[config.output]}
        else:
            with captured(self.network, names) as values:
                outputs = tensors_of(self.network(numbers))
        if missing := [name for name in names if name not in values]:
            raise ValueError(f"features: the network did not compute {missing[0]}")
        forms = {name: form_of(output) for name, output in outputs.items()}
        chosen = choose_output(forms, self.space, config.output, config.classes)
        return outputs[chosen], [values[name] for name in names]

    def _axis_of(self, output: Tensor, numbers: Tensor) -> int:
        """The axis that holds the classes, fixed once for all pictures. If both could, the other
        two axes are proportional to height and width; a square picture has the layout of the
        network's input."""
        axis = class_axis(form_of(output), self.space, self.config.classes)
        if axis is not None:
            return axis
        last = isinstance(self.network, OnnxNetwork) and self.network.form.channels_last
        height, width = numbers.shape[1:3] if last else numbers.shape[2:]
        _, second, third, fourth = output.shape
        sides = {1: (third, fourth), 3: (second, third)}
        fitting = [axis for axis, (h, w) in sides.items() if h * width == w * height]
        return fitting[0] if len(fitting) == 1 else 3 if last else 1


def _completed(config: SegmenterConfig, network: OnnxNetwork, space: LabelSpace) -> SegmenterConfig:
    """The settings with the size that a graph requires and the name of its output."""
    if network.form.dtype == torch.uint8:
        for name, value in {"white": 255, "mean": (0, 0, 0), "std": (1, 1, 1)}.items():
            if (got := getattr(config, name)) != value:
                raise ValueError(f"takes bytes: expected {name} {value}, got {got}")
    output = choose_output(network.outputs, space, config.output, config.classes)
    size, fixed = config.size, network.size
    if fixed != (None, None):
        if size is None and None not in fixed:
            size = cast(tuple[int, int], fixed)
        if not isinstance(size, tuple):
            raise ValueError(f"takes images of {_by(fixed)}; expected a size among the settings")
        if any(expected not in (None, got) for got, expected in zip(size, fixed, strict=True)):
            raise ValueError(f"takes images of {_by(fixed)}, the settings say {_by(size)}")
    return dataclasses.replace(config, size=size, output=output)


def _by(size: Sequence[int | None]) -> str:
    return "x".join("any" if length is None else str(length) for length in size)
