"""The settings of the method: frozen, validated, with presets and a fingerprint; the version."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from typing import Any

from .taxonomy import CATEGORIES, LabelSpace

METHOD_REVISIONS = {"residuals": 1, "harmonics": 2}
"""By aggregation: increased whenever the same settings give other numbers; part of fingerprints."""

CATEGORY_COUNT = len(CATEGORIES)
"""K of the paper: Table II has eight categories, and every descriptor has eight blocks."""

CHOICES = {
    "thinning": ("zhang-suen", "guo-hall"),
    "context": ("skeleton", "keypoints"),
    "aggregation": ("residuals", "harmonics"),
    "anchor": ("vanishing-column", "middle"),
}
"""The values of the settings that are names."""

_INTEGERS = {
    "working_size": (1, 1 << 14),
    "rings": (1, 64),
    "sectors": (1, 360),
    "harmonics": (1, 1 << 12),
    "boundary_harmonics": (1, 1 << 12),
}
_FRACTIONS = {
    "opening": (0.0, 0.5),
    "closing": (0.0, 0.5),
    "hole_area": (0.0, 1.0),
    "region_area": (0.0, 1.0),
    "radius": (5e-324, 1.0),
    "inner_radius": (5e-324, 1.0),
    "spectral_weight": (0.0, 4.0),
    "power": (0.5, 1.0),
}
"""The least and the greatest value of each setting; that of ``radius`` is above 0."""

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "working_size": None,
        "rings": 5,
        "sectors": 12,
        "inner_radius": 1 / 16,
        "aggregation": "residuals",
    },
    "default": {},
}

AREA_LAYERS = 6
"""Layers of the aggregation harmonics: guard rail counts as building, parking as ground."""

BOUNDARY_DIRECTIONS = 4

FAINT = 1e-4
"""Far below this, coefficients of harmonics stay linear: a power would amplify a rounding error of
1e-7 to 5e-6."""

_ONLY_RESIDUALS = ("opening", "closing", "hole_area", "region_area", "thinning", "context")
_ONLY_HARMONICS = ("anchor", "harmonics", "boundary_harmonics", "spectral_weight", "power")

_AREA_UNIT = 10**6
_RING_UNIT = 10**9


@dataclass(frozen=True)
class SSRVLADConfig:
    """Every setting of the descriptor; where the paper is silent, (silent) says so.

    Lengths and areas are fractions of the image. The methods below turn them into pixels of the
    working grid in integer arithmetic, so that every backend computes the same pixels.

    Attributes:
        labels_as: the label space: its name, the path of a YAML file that defines it, or a
            `LabelSpace`. It says how label ids are read and is *not* part of the fingerprint.
        working_size: shorter side of the working grid in pixels, 1 to 16384. A larger label map is
            reduced to it by majority vote, a smaller one keeps its size. ``None`` keeps every size
            (the paper).
        opening, closing: radii of the squares that open and then close each layer, fractions of
            the shorter side, 0 to 0.5 (silent). These and the next three are for residuals only.
        hole_area: enclosed holes of fewer pixels than this fraction of the image are filled, 0 to
            1 (silent).
        region_area: regions of fewer pixels than this fraction of the image are dropped, 0 to 1
            (silent).
        thinning: ``"zhang-suen"`` or ``"guo-hall"`` (silent).
        rings, sectors: N and M of the paper, the numbers of log-spaced rings, 1 to 64, and of equal
            sectors, 1 to 360, of the shape context.
        radius: R of the paper as a fraction of the image diagonal, above 0 to 1 (silent).
        inner_radius: outer radius of the first ring as a fraction of R, above 0 to 1 (silent). From
            ring to ring the radius grows by a constant factor: 2 with five rings and 1/16, as in
            Belongie et al. 2002.
        context: the points that the histograms of Eq. 2 count: ``"skeleton"`` pixels or
            ``"keypoints"``. The paper can be read either way. For residuals only.
        aggregation: ``"residuals"`` of the keypoints' histograms to the centre's (Eq. 2), or
            ``"harmonics"`` of soft histograms of area and of boundary directions. The fields that
            follow are for harmonics only and not in the paper.
        anchor: the column around which the histograms count: the ``"vanishing-column"``, towards
            which the street narrows, or the ``"middle"`` of the image.
        harmonics, boundary_harmonics: numbers of coefficients of each of six areas and of each of
            four boundary directions, those of the smoothest basis functions over the bins. At most
            ``rings * (sectors - 1)``, or ``rings * sectors`` if sectors is odd.
        spectral_weight: exponent, 0 to 4; the larger, the more the finer basis functions weigh.
        power: exponent of the power normalisation, 0.5 to 1. It applies to the absolute value of
            every number; the sign stays. A lower exponent would enlarge rounding errors of zeros.

    Raises:
        ValueError: a setting is outside its range; the message names it, what was got and what
            was expected.

    Examples:
        >>> SSRVLADConfig.from_preset("paper", labels_as="camvid-11").preset
        'paper'
    """

    labels_as: str | os.PathLike[str] | LabelSpace = "cityscapes-trainids"
    working_size: int | None = 120
    opening: float = 0.0
    closing: float = 0.01
    hole_area: float = 0.002
    region_area: float = 0.0005
    thinning: str = "zhang-suen"
    rings: int = 6
    sectors: int = 20
    radius: float = 0.5
    inner_radius: float = 1 / 6
    context: str = "skeleton"
    aggregation: str = "harmonics"
    anchor: str = "vanishing-column"
    harmonics: int = 64
    boundary_harmonics: int = 24
    spectral_weight: float = 1.0
    power: float = 0.75

    def __post_init__(self) -> None:
        if isinstance(self.labels_as, os.PathLike):
            object.__setattr__(self, "labels_as", os.fspath(self.labels_as))
        if not isinstance(self.labels_as, (str, LabelSpace)):
            raise ValueError(
                f"labels_as must be a name, a path or a LabelSpace, got {self.labels_as!r}"
            )
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        for name, (lowest, highest) in _INTEGERS.items():
            number = getattr(self, name)
            whole = isinstance(number, int) and not isinstance(number, bool)
            if (name, number) != ("working_size", None) and not (
                whole and lowest <= number <= highest
            ):
                raise ValueError(
                    f"{name} must be an integer from {lowest} to {highest}, got {number!r}"
                )
        for name, (least, most) in _FRACTIONS.items():
            value = getattr(self, name)
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or not least <= value <= most:
                words = "above 0" if 0 < least < 0.1 else f"from {least:g}"
                raise ValueError(f"{name} must be a fraction {words} to {most}, got {value!r}")
            # equal settings, like 1 and 1.0, get one fingerprint
            object.__setattr__(self, name, float(value) + 0.0)
        basis = self.rings * (2 * ((self.sectors + 1) // 2) - 1)
        for name in ("harmonics", "boundary_harmonics"):
            if self.aggregation == "harmonics" and getattr(self, name) > basis:
                raise ValueError(
                    f"{name} must be at most {basis} with {self.rings} rings and {self.sectors} "
                    f"sectors, got {getattr(self, name)}"
                )

    @classmethod
    def from_preset(cls, preset: str, **settings: Any) -> SSRVLADConfig:
        """A preset, ``"paper"`` or ``"default"``, with the given settings changed; an unknown
        preset or setting, and a value outside its range, are a ValueError."""
        if preset not in tuple(PRESETS):
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
        return cls.from_dict({**PRESETS[preset], **settings})

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> SSRVLADConfig:
        """The config that `to_dict` wrote; a key that is no setting of this version, and a value
        outside its range, are a ValueError."""
        names = cls.__dataclass_fields__
        if unknown := sorted(settings.keys() - names.keys()):
            raise ValueError(
                f"unknown setting {unknown[0]!r}; the settings are {', '.join(sorted(names))}"
            )
        space = settings.get("labels_as")
        if isinstance(space, dict):
            settings = {**settings, "labels_as": LabelSpace.from_dict(space, "labels_as")}
        return cls(**settings)

    def to_dict(self) -> dict[str, Any]:
        """Every setting by name, ready for JSON; a `LabelSpace` is a mapping in it."""
        settings = dict(vars(self))
        if isinstance(self.labels_as, LabelSpace):
            settings["labels_as"] = self.labels_as.to_dict()
        return settings

    def used(self) -> dict[str, Any]:
        """`to_dict` without the settings that the aggregation does not use."""
        settings = self.to_dict()
        for unused in _ONLY_HARMONICS if self.aggregation == "residuals" else _ONLY_RESIDUALS:
            del settings[unused]
        return settings

    @property
    def preset(self) -> str:
        """The name of the preset with these settings, or ``"custom"``."""
        for name in PRESETS:
            if self.from_preset(name, labels_as=self.labels_as) == self:
                return name
        return "custom"

    @property
    def labels_name(self) -> str:
        """The name or path in ``labels_as``, or the name of its `LabelSpace`."""
        space = self.labels_as
        return space.name if isinstance(space, LabelSpace) else os.fspath(space)

    @property
    def fingerprint(self) -> str:
        """16 hex digits over the method's revision and every setting that the aggregation uses but
        ``labels_as``. Two descriptors are comparable only if their fingerprints are equal; a
        database stays valid when a preset changes."""
        settings = self.used()
        del settings["labels_as"]
        if self.aggregation == "residuals":
            del settings["aggregation"]  # fingerprints of residuals are older than this setting
        settings["revision"] = METHOD_REVISIONS[self.aggregation]
        text = json.dumps(settings, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def length(self) -> int:
        """Numbers in a descriptor: K * N * M, or those of six areas and four directions."""
        if self.aggregation == "residuals":
            return CATEGORY_COUNT * self.rings * self.sectors
        return AREA_LAYERS * self.harmonics + BOUNDARY_DIRECTIONS * self.boundary_harmonics

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the working grid: the aspect of the image, never enlarged."""
        shorter = min(height, width)
        size = min(self.working_size or shorter, shorter)
        return _rounded(height * size, shorter), _rounded(width * size, shorter)

    def radius_pixels(self, fraction: float, height: int, width: int) -> int:
        """A morphology radius in pixels of a ``height x width`` grid."""
        return _rounded(round(fraction * _AREA_UNIT) * min(height, width), _AREA_UNIT)

    def area_pixels(self, fraction: float, height: int, width: int) -> int:
        """The least number of pixels that is *not* smaller than ``fraction`` of the grid."""
        return -(-round(fraction * _AREA_UNIT) * height * width // _AREA_UNIT)

    def ring_limits(self, height: int, width: int) -> tuple[int, ...]:
        """Largest squared distance of each ring, in pixels of the grid, innermost first. A point at
        squared distance ``d2`` lies in the first ring whose limit is not below it: a boundary
        belongs to the ring inside it. Equal or zero limits leave a ring empty."""
        steps = [
            1 - ring / (self.rings - 1) if self.rings > 1 else 0.0 for ring in range(self.rings)
        ]
        squares = [(self.radius * self.inner_radius**step) ** 2 for step in steps]
        diagonal = height * height + width * width
        return tuple(round(square * _RING_UNIT) * diagonal // _RING_UNIT for square in squares)


def package_version() -> str:
    """The version of the installed package; 0.0 for a checkout that was never installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("ssrvlad-torch")
    except PackageNotFoundError:
        return "0.0"


def _rounded(numerator: int, denominator: int) -> int:
    return (2 * numerator + denominator) // (2 * denominator)
