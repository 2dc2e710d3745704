"""The preparation of pictures for a network: the settings and the module."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from ..files import check_pixels

OF_SIDES = (
    "a network for one size, or for sides that are multiples of a number, needs size: or "
    "multiple: in a YAML file"
)
"""The hint where a network fails at a size."""

_REAL = (int, float)
_SIDES = "height and width in pixels, or the shorter side"


@dataclass(frozen=True)
class SegmenterConfig:
    """The input of a network; the defaults are ImageNet statistics in RGB, as of torchvision. A
    setting outside its range is a ValueError that names it.

    Attributes:
        size: every image is resized (bilinear, antialiased) to this height and width, or to this
            shorter side with its aspect kept. ``None`` is the size that an ONNX graph requires, or
            else keeps the size of each image.
        longest: with the shorter side as ``size``, the most that the longer side may have.
        multiple: both sides become multiples of this number, unless ``size`` gives both.
        white: the number for the brightest pixel: 1, or 255 for networks that take byte values.
        mean, std: subtracted, then divided by, in the network's order of colours.
        colour_order: ``"rgb"`` or ``"bgr"``.
        output: name of the output to use, if several outputs of the network fit.
        classes: the first channel of the class scores to use and the one after the last.
        features: names of the activations that are features; ``None`` uses the rule of
            `activations.find_activations`.
    """

    size: tuple[int, int] | int | None = None
    longest: int | None = None
    multiple: int = 1
    white: float = 1.0
    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)
    colour_order: str = "rgb"
    output: str | None = None
    classes: tuple[int, int] | None = None
    features: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        side = 1 if self.size is None else self.size
        sides = side if isinstance(side, tuple) else (side,)
        longest = 1 if self.longest is None else self.longest
        ends, names = self.classes, self.features
        for name, fits, expected in (
            ("size", len(sides) in (1, 2) and _numbers(sides, len(sides), int), _SIDES),
            ("longest", _numbers((longest,), 1, int), "a number of pixels"),
            ("multiple", _numbers((self.multiple,), 1, int), "a number of pixels"),
            ("white", _numbers((self.white,), 1, _REAL), "a number above 0"),
            ("mean", _numbers(self.mean, 3, _REAL, -math.inf), "three numbers"),
            ("std", _numbers(self.std, 3, _REAL), "three numbers above 0"),
            ("colour_order", self.colour_order in ("rgb", "bgr"), "rgb or bgr"),
            ("output", isinstance(self.output, str | None), "a name"),
            (
                "classes",
                ends is None or (_numbers(ends, 2, int, above=-1) and ends[0] < ends[1]),
                "FIRST:LAST, LAST not included",
            ),
            (
                "features",
                names is None
                or (isinstance(names, tuple) and names and all(isinstance(n, str) for n in names)),
                "a list of names of activations",
            ),
        ):
            if not fits:
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")
        check_pixels(sides[0], sides[-1])

    @classmethod
    def of(cls, settings: Mapping[str, Any], beside: Sequence[str] = ()) -> SegmenterConfig:
        """Settings by their names, as in a YAML file: a list counts as a tuple, and ``classes`` may
        be a text, ``"0:19"``. An unknown name is a ValueError that lists the known ones, and
        before them those ``beside`` that stand beside settings."""
        names = [*beside, *(field.name for field in fields(cls))]
        if unknown := [name for name in settings if name not in names]:
            raise ValueError(f"unknown setting {unknown[0]!r}; expected {', '.join(names)}")
        plain: dict[str, Any] = dict(settings)
        plain |= {k: tuple(v) for k, v in settings.items() if isinstance(v, list)}
        if isinstance(ends := plain.get("classes"), str):
            if not (match := re.fullmatch(r"([0-9]*):([0-9]+)", ends)):
                raise ValueError(f"classes must be FIRST:LAST, LAST not included, got {ends!r}")
            plain["classes"] = int(match[1] or 0), int(match[2])
        return cls(**plain)

    @property
    def resizes(self) -> bool:
        """Whether the size of an image may change."""
        return self.size is not None or self.multiple > 1

    def network_size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the network's input for an image of this height and width."""
        if isinstance(self.size, tuple):
            return self.size
        if self.size is not None:
            short, target = torch.sym_min(height, width), self.size
            if self.longest is not None:  # the shorter side if the longer one is at its most
                target = torch.sym_min(target, self.longest * short // torch.sym_max(height, width))
            height, width = height * target // short, width * target // short
        step = self.multiple
        if step == 1:
            return height, width
        sides = (torch.sym_max(step, (side + step // 2) // step * step) for side in (height, width))
        return next(sides), next(sides)


class Preparation(nn.Module):
    """Pictures ``(B, H, W, 3)`` uint8 in RGB -> the input of a network, ``(B, 3, h, w)`` float32:
    ``nn.Sequential(Preparation(config), network, head)`` is a PyTorch module from pictures to
    descriptors, which `torch.onnx.export` traces for any size. Pictures are resized by the
    antialiased bilinear filter, as of Pillow and of the ONNX operator ``Resize``.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
        >>> Preparation(SegmenterConfig(size=(64, 128)))(torch.zeros(1, 9, 9, 3)).shape
        torch.Size([1, 3, 64, 128])
    """

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        from kornia.color import RgbToBgr
        from kornia.enhance import Normalize

        self.config = config
        mean, std = (
            torch.tensor(numbers, dtype=torch.float32) / config.white
            for numbers in (config.mean, config.std)
        )
        self.steps = nn.Sequential(
            RgbToBgr() if config.colour_order == "bgr" else nn.Identity(), Normalize(mean, std)
        )

    def forward(self, images: Tensor) -> Tensor:
        """The input of the network for a batch of pictures."""
        planes = images.permute(0, 3, 1, 2).float() / 255
        if self.config.resizes:
            size = self.config.network_size(*images.shape[1:3])
            planes = interpolate(planes, size, mode="bilinear", antialias=True)
        numbers: Tensor = self.steps(planes)
        return numbers


def _numbers(values: object, count: int, kind: Any, above: float = 0) -> bool:
    return (
        isinstance(values, tuple)
        and len(values) == count
        and all(isinstance(v, kind) and not isinstance(v, bool) for v in values)
        and all(above < v < math.inf for v in values)
    )
