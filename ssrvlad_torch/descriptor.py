"""The method: label map -> layers -> histograms -> 480 numbers."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from operator import index
from typing import Any, Protocol

import numpy.typing as npt
import torch
from torch import Tensor, nn

from .bitplanes import unpack
from .config import SSRVLADConfig
from .explanation import Explanation
from .front_end import FrontEnd, as_tensor, label_map
from .native.operator import UnknownIdError, describe, is_built, method_of, operator
from .soft.descriptor import SoftSSRVLAD
from .stages.centroid import centre_table, centroids
from .stages.harmonics import Harmonics
from .stages.keypoints import end_points, intersections
from .stages.layers import categorise, refuse_unknown
from .stages.residuals import Residuals, masks_of
from .taxonomy import LabelSpace


class Aggregation(Protocol):
    """How layers become a descriptor: `Residuals` or `Harmonics`."""

    def histograms(self, layers: Tensor) -> Any:
        """What is counted, as a tuple of tensors."""

    def descriptor(self, histograms: Any) -> Tensor:
        """``(B, D)`` float32 of the histograms."""


AGGREGATIONS: dict[str, Callable[[SSRVLADConfig], Aggregation]] = {
    "residuals": Residuals,
    "harmonics": Harmonics,
}


class SSRVLAD(nn.Module):
    """Label maps or class scores -> place descriptors (Nie, Feng et al., arXiv 2202.03677).

    The module has no weights and needs no training. It runs where its input lies, on CPU or
    CUDA, and counts the same integers on both. Its tables are buffers that follow ``to(device)``
    and that ``half()`` does not round; they are not in the ``state_dict()``, which is empty.

    On a CPU the native core does the work as one operator, which ``torch.compile`` and
    ``torch.export`` take as it is and which has nothing to gain from them. Where it was not built,
    or with ``head.native = False``, and on CUDA, the stages in torch give the same numbers;
    ``torch.compile`` leaves them alone and ``torch.export`` refuses them. `export_head` writes the
    head as an ONNX file. ``copy.deepcopy`` and ``pickle`` take it with its settings.

    Args:
        config: the settings; without, the preset ``default``.
        surrogate: give class scores that require a gradient that of `SoftSSRVLAD`; the numbers
            stay the same. Without it, such scores are warned of once.

    Shape:
        - input: ``(B, H, W)`` label ids of any integer dtype, or ``(B, C, H, W)`` floating class
          scores (logits or probabilities; the largest wins, the first of equals), any ``H`` and
          ``W`` from 1. A tensor or a NumPy array.
        - output: ``(B, 480)`` float32 of length 1, or exact zeros for an empty image, in which
          no category is seen.

    Raises:
        ValueError: wrong rank or dtype, an empty batch or image, an id outside the label space,
            NaN scores, or a class count that does not fit the label space. The message names
            the offender, what was got and what was expected.

    Example:
        >>> head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
        >>> head(torch.zeros(2, 240, 320, dtype=torch.uint8)).shape
        torch.Size([2, 480])
    """

    def __init__(self, config: SSRVLADConfig | None = None, surrogate: bool = False) -> None:
        super().__init__()
        self.config = config or SSRVLADConfig()
        self._front_end = FrontEnd(self.config)
        self._aggregation: Aggregation = AGGREGATIONS[self.config.aggregation](self.config)
        self._surrogate = SoftSSRVLAD(self.config) if surrogate else None
        self.native = is_built()
        self._method = method_of(self.config)
        self._warned = False

    @classmethod
    def from_preset(cls, preset: str, surrogate: bool = False, **settings: Any) -> SSRVLAD:
        """The head of a preset, ``"paper"`` or ``"default"``; see `SSRVLADConfig.from_preset`."""
        return cls(SSRVLADConfig.from_preset(preset, **settings), surrogate)

    @property
    def label_space(self) -> LabelSpace:
        """The label space of the input, as it was when the head was made."""
        return self._front_end.label_space

    def forward(self, labels: Tensor | npt.NDArray[Any]) -> Tensor:
        """The descriptors of a batch."""
        labels = as_tensor(labels)
        if labels.is_cpu and self.native and not self._takes_gradient(labels):
            return self._describe_by_core(labels)
        descriptor: Tensor = self._describe_by_stages(labels)
        return descriptor

    # as torch.compiler.disable, which has torch load its compiler when this module is imported
    @torch._disable_dynamo  # type: ignore[attr-defined]
    def _describe_by_stages(self, labels: Tensor) -> Tensor:
        with torch.autocast(labels.device.type, enabled=False):
            layers = self._front_end(labels)  # Table II
            histograms = self._aggregation.histograms(layers)  # Eq. 1, d_i and d_c of Eq. 2
            descriptor = self._aggregation.descriptor(histograms)  # Eq. 2
            return self._with_gradient(descriptor, labels, layers)

    def _describe_by_core(self, labels: Tensor) -> Tensor:
        """The same numbers by the native core."""
        labels = label_map(labels, self.label_space)
        table, origin = self._front_end.table.to(labels.device), self._front_end.origin
        try:
            run = operator if torch.compiler.is_compiling() else describe
            descriptor: Tensor = run(labels, table, origin, self._method)
            return descriptor
        except UnknownIdError:
            refuse_unknown(labels, categorise(labels, table, origin), self.label_space)
            raise

    def explain(self, labels: Tensor | npt.NDArray[Any]) -> Explanation:
        """Every step from the label map to the descriptor; input and errors as for a call.

        Clean layers, skeletons, keypoints and centres are those of the paper; the harmonics of
        ``default`` do not look at them.
        """
        labels = as_tensor(labels)
        with torch.autocast(labels.device.type, enabled=False):
            layers = self._front_end(labels)
            masks = masks_of(layers, self.config)
            histograms = self._aggregation.histograms(layers)
            return Explanation(
                labels=label_map(labels, self.label_space),
                label_space=self.label_space,
                layers=unpack(masks.layers),
                clean_layers=unpack(masks.clean),
                skeleton=unpack(masks.skeleton),
                end_points=unpack(end_points(masks.skeleton)),
                intersections=unpack(intersections(masks.skeleton)),
                centres=centre_table(centroids(masks.clean), len(masks.clean)),
                histograms=histograms,
                descriptor=self._aggregation.descriptor(histograms),
            )

    def sweep(self, labels: Tensor | npt.NDArray[Any], columns: Sequence[int]) -> Tensor:
        """Descriptors from several anchors, for a query that may be turned or moved aside.

        Args:
            labels: as for a call.
            columns: S anchors, in columns of the working grid right of the usual one, at least one
                and none beyond a million.

        Returns:
            ``(B, S, 480)`` float32; that of column 0 is the descriptor.

        Raises:
            ValueError: the descriptors have no such anchor, as those of ``paper``.
        """
        columns = _anchors(columns)
        if not isinstance(self._aggregation, Harmonics):
            raise ValueError(
                f"a sweep is of the aggregation harmonics, got {self.config.aggregation}"
            )
        labels = as_tensor(labels)
        with torch.autocast(labels.device.type, enabled=False):
            layers = self._front_end(labels)
            seen = (self._aggregation.histograms(layers, column) for column in columns)
            return torch.stack([self._aggregation.descriptor(each) for each in seen], dim=1)

    def _with_gradient(self, descriptor: Tensor, scores: Tensor, layers: Tensor) -> Tensor:
        """The same numbers with the gradient of the surrogate, where one is asked for."""
        if not self._takes_gradient(scores):
            return descriptor
        if self._surrogate is None:
            if not self._warned:
                warnings.warn(_NO_GRADIENT, stacklevel=2)
            self._warned = True
            return descriptor
        soft: Tensor = self._surrogate(scores, layers)
        return descriptor + (soft - soft.detach()).float()

    @staticmethod
    def _takes_gradient(labels: Tensor) -> bool:
        return labels.requires_grad and torch.is_grad_enabled()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """From a pickle, perhaps of a machine with another core."""
        super().__setstate__(state)
        self.native = self.native and is_built()

    def extra_repr(self) -> str:
        """What ``print(head)`` shows: the preset, the label space and the fingerprint."""
        return ", ".join((self.config.preset, self.config.labels_name, self.config.fingerprint))


def query_head(config: SSRVLADConfig, columns: Sequence[int] = ()) -> SSRVLAD:
    """What describes queries: from all anchors, where there are some and the method has them."""
    sweeps = columns and config.aggregation == "harmonics"
    return SweepHead(config, columns) if sweeps else SSRVLAD(config)


class SweepHead(SSRVLAD):
    """`SSRVLAD.sweep` as a module, for what encodes queries: ``(B, S, 480)``.

    Args:
        config: the settings.
        columns: the anchors.
    """

    def __init__(self, config: SSRVLADConfig, columns: Sequence[int]) -> None:
        super().__init__(config)
        self.columns = _anchors(columns)

    def forward(self, labels: Tensor | npt.NDArray[Any]) -> Tensor:
        """The descriptors of a batch from all anchors."""
        return self.sweep(labels, self.columns)


def _anchors(columns: Sequence[int]) -> tuple[int, ...]:
    """Columns of a sweep, checked."""
    try:
        checked = tuple(map(index, columns))
    except TypeError:
        checked = ()
    if not checked or max(map(abs, checked)) > _FARTHEST:
        raise ValueError(
            f"columns: expected one or more integers from -{_FARTHEST} to {_FARTHEST}, "
            f"got {columns!r}"
        )
    return checked


_FARTHEST = 1_000_000

_NO_GRADIENT = (
    "the class scores require a gradient and SSRVLAD has none: use SSRVLAD(..., surrogate=True) "
    "to train through it, or scores.detach()"
)
