"""The method: label map -> layers -> histograms -> 480 numbers."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from operator import index
from typing import Any, Protocol

import numpy.typing as npt
import torch
from torch import Tensor, nn

from .config import SSRVLADConfig
from .native import core
from .native.operator import UnknownIdError, describe, operator
from .stages.explanation import Explanation, explain
from .stages.front_end import FrontEnd, as_tensor, label_map, labels_in
from .stages.harmonics import Harmonics
from .stages.layers import refuse_unknown
from .stages.residuals import ResidualHistograms, Residuals
from .stages.tracing import exporting
from .taxonomy import LabelSpace

Labels = Tensor | npt.NDArray[Any] | Mapping[Any, Any]
"""Label maps or class scores, or the outputs of a network by name."""


class Aggregation(Protocol):
    """How layers become a descriptor: `Residuals` or `Harmonics`."""

    def histograms(self, layers: Tensor) -> Any:
        """The histograms of the layers, a tuple of tensors."""

    def descriptor(self, histograms: Any) -> Tensor:
        """``(B, D)`` float32 descriptors."""


class SSRVLAD(nn.Module):
    """Label maps or class scores -> place descriptors (Nie, Feng et al., arXiv 2202.03677).

    The module has no weights and needs no training. It runs on CPU and CUDA, and counts the same
    integers on both. Its tables are buffers: they follow ``to(device)``, ``half()`` does not round
    them, and the ``state_dict()`` is empty.

    On a CPU the native core computes the descriptors as one operator, which ``torch.compile`` keeps
    and does not make faster. On CUDA, without a built core, with ``head.native = False``, or where
    class scores require a gradient, the stages in torch give the same numbers; ``torch.compile``
    runs them without compiling. ``torch.export`` and ``torch.onnx.export(dynamo=True)`` record the
    stages of ``default``. Of ``paper``, ``torch.export`` keeps the operator and
    ``torch.onnx.export`` is refused: `export_head` writes the head as an ONNX file.
    ``torch.jit.trace`` and ``torch.onnx.export(dynamo=False)`` are refused. Class scores that
    require a gradient give a warning, once: they need `SurrogateSSRVLAD`. ``copy.deepcopy`` and
    ``pickle`` keep the settings.

    Args:
        config: the settings; the default is the preset ``default``.
        columns: S anchors; with them a call is a `sweep`.

    Shape:
        - input: ``(B, H, W)`` label ids of any integer dtype, or ``(B, C, H, W)`` floating class
          scores (logits or probabilities; the largest wins, the first of equals), any ``H`` and
          ``W`` from 1. A tensor, a NumPy array, or a mapping with one such tensor, or one named
          ``out`` or ``logits``.
        - output: ``(B, D)`` float32 of length 1, ``D = config.length``, 480 by default, or exact
          zeros for an empty image, one that shows no category; with S anchors ``(B, S, D)``.

    Raises:
        ValueError: input on another device than the module, wrong rank or dtype, an empty batch or
            image, an id outside the label space, NaN scores, or a class count that does not fit
            the label space. The message names the offender, what was got and what was expected.
        RuntimeError: under ``torch.jit.trace`` or ``torch.onnx.export(dynamo=False)``, which would
            record the numbers of one input.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch import SSRVLAD
        >>> head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
        >>> head(torch.zeros(2, 240, 320, dtype=torch.uint8)).shape
        torch.Size([2, 480])
    """

    def __init__(self, config: SSRVLADConfig | None = None, columns: Sequence[int] = ()) -> None:
        super().__init__()
        if not isinstance(config, SSRVLADConfig | None):
            raise ValueError(f"expected an SSRVLADConfig, got {config!r}; see SSRVLAD.from_preset")
        self.config = config or SSRVLADConfig()
        self.columns = _checked(columns) if columns else ()
        self._front_end = FrontEnd(self.config)
        harmonic = self.config.aggregation == "harmonics"
        self._aggregation: Aggregation = (Harmonics if harmonic else Residuals)(self.config)
        self.native = core().library is not None
        settings = self.config.to_dict()
        del settings["labels_as"]
        self._method = json.dumps(settings)
        self._warned = False

    @classmethod
    def from_preset(cls, preset: str, **settings: Any) -> SSRVLAD:
        """The head of a preset, ``"paper"`` or ``"default"``; see `SSRVLADConfig.from_preset`."""
        return cls(SSRVLADConfig.from_preset(preset, **settings))

    @property
    def label_space(self) -> LabelSpace:
        """The label space of the input, as read when the head was created."""
        return self._front_end.label_space

    def forward(self, labels: Labels) -> Tensor:
        """The descriptors of a batch."""
        if self.columns and not exporting():
            return self.sweep(labels, self.columns)
        labels = self._input(labels)
        if exporting() and isinstance(self._aggregation, Harmonics):
            # a graph cannot raise: an unknown id gives NaN
            descriptors, unknown, *_ = self.counted(labels)
            wrong = (unknown > 0).view(-1, *[1] * (descriptors.ndim - 1))
            return torch.where(wrong, torch.nan, descriptors)
        if exporting() and torch.onnx.is_in_onnx_export():
            raise ValueError(
                "torch.onnx.export cannot record the loops of residuals: expected export_head or "
                "ssrvlad fuse"
            )
        requires_gradient = labels.requires_grad and torch.is_grad_enabled()
        if labels.is_cpu and self.native and not requires_gradient:
            return self._describe_by_core(labels)
        descriptor: Tensor = self._describe_by_stages(labels)
        return descriptor

    # torch.compiler.disable would load torch's compiler when this module is imported
    @torch._disable_dynamo  # type: ignore[attr-defined]
    def _describe_by_stages(self, labels: Tensor) -> Tensor:
        with torch.autocast(labels.device.type, enabled=False):
            layers = self._front_end(labels)  # Table II
            histograms = self._aggregation.histograms(layers)  # Eq. 1, d_i and d_c of Eq. 2
            if labels.requires_grad and torch.is_grad_enabled() and not self._warned:
                warnings.warn(_NO_GRADIENT, stacklevel=2)
                self._warned = True
            return self._aggregation.descriptor(histograms)  # Eq. 2

    def _describe_by_core(self, labels: Tensor) -> Tensor:
        ids = label_map(labels, self.label_space)
        run = operator if torch.compiler.is_compiling() else describe
        try:
            descriptor: Tensor = run(
                ids, self._front_end.table, self._front_end.origin, self._method
            )
            return descriptor
        except UnknownIdError:
            refuse_unknown(ids, self.label_space)
            raise

    def _input(self, labels: Labels) -> Tensor:
        if isinstance(labels, Mapping):
            labels = labels_in(labels, self.label_space)
        tensor, device = as_tensor(labels), self._front_end.table.device
        if tensor.device != device:
            raise ValueError(f"expected labels on {device}, as the head is, got {tensor.device}")
        return tensor

    def counted(self, labels: Tensor) -> tuple[Tensor, ...]:
        """The outputs of exported files, which cannot raise an error: the descriptors of a batch as
        a call gives them, and ``(B,)`` int64, the number of pixels of each image with an unknown
        id, which belong to no layer; of ``paper`` also ``(B, 8)`` int64, the number of keypoints of
        each layer."""
        layers, unknown = self._front_end.counted(label_map(labels, self.label_space))
        if self.columns:
            assert isinstance(self._aggregation, Harmonics)
            return self._aggregation.sweep(layers, self.columns), unknown
        histograms = self._aggregation.histograms(layers)
        descriptor = self._aggregation.descriptor(histograms)
        if isinstance(histograms, ResidualHistograms):
            return descriptor, unknown, histograms.counts
        return descriptor, unknown

    def explain(self, labels: Labels) -> Explanation:
        """Every step from the label map to the descriptor; input and errors are those of a call.
        Clean layers, skeletons, keypoints and centres are those of the paper; the harmonics of
        ``default`` do not use them."""
        ids = label_map(self._input(labels), self.label_space)
        with torch.autocast(ids.device.type, enabled=False):
            layers = self._front_end(ids)
            histograms = self._aggregation.histograms(layers)
            descriptor = self._aggregation.descriptor(histograms)
            return explain(ids, self.label_space, layers, self.config, histograms, descriptor)

    def sweep(self, labels: Labels, columns: Sequence[int]) -> Tensor:
        """Descriptors from several anchors, for a query whose camera may be turned or moved aside.

        Args:
            labels: as for a call.
            columns: S offsets of the anchor to the right, in columns of the working grid; at least
                one, each from -1,000,000 to 1,000,000.

        Returns:
            ``(B, S, D)`` float32. Offset 0 gives the descriptor of a call.

        Raises:
            ValueError: the aggregation has no anchor, as in ``paper``, or the columns are not as
                above.
        """
        columns = _checked(columns)
        if not isinstance(self._aggregation, Harmonics):
            raise ValueError(
                f"a sweep needs the aggregation harmonics, got {self.config.aggregation}"
            )
        labels = self._input(labels)
        with torch.autocast(labels.device.type, enabled=False):
            return self._aggregation.sweep(self._front_end(labels), columns)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a pickle, perhaps on a machine without the native core."""
        super().__setstate__(state)
        self.native = self.native and core().library is not None

    def extra_repr(self) -> str:
        """What ``print(head)`` shows: the preset, the label space and the fingerprint."""
        return ", ".join((self.config.preset, self.config.labels_name, self.config.fingerprint))


def _checked(columns: Sequence[int]) -> tuple[int, ...]:
    """The columns of a sweep as integers; other columns are a ValueError."""
    try:
        integers = tuple(map(index, columns))
    except TypeError:
        integers = ()
    if not integers or max(map(abs, integers)) > _MAX_COLUMN:
        raise ValueError(
            f"columns: expected one or more integers from -{_MAX_COLUMN} to {_MAX_COLUMN}, "
            f"got {columns!r}"
        )
    return integers


_MAX_COLUMN = 1_000_000

_NO_GRADIENT = (
    "the class scores require a gradient and SSRVLAD has none: use SurrogateSSRVLAD to train "
    "through it, or scores.detach()"
)
