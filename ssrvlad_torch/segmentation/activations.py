"""Activations inside a network: which of them are features, and taking them while it runs.

Features are the last activation at the target stride before a coarser one begins, and the same of
the next coarser stride, if there is one, where an activation counts if it has more than half the
channels of the widest of its stride. The target is stride 8, or half the coarsest stride if that is
finer, or else the nearest that there is. An activation has the name of its module, and of a module
that runs several times ``NAME#CALL``: ``act#2`` is the output of the second call."""

import itertools
import math
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from difflib import get_close_matches
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from .onnx_network import OnnxNetwork

STRIDE, STRIDES = 8, (4, 32)
"""The coarsest stride that is sought, and the smallest and the largest that are near enough."""

HIDDEN = "hidden_states"
"""What the names of the activations of a transformer begin with."""

_CALL = "#"
_UNEVEN = 1.5
"""The last axes of a tensor whose strides differ by this factor are not the height and width of a
map, but of one with the channels last; unless they are equal, as where a network first makes every
picture a square."""


class Activation(NamedTuple):
    """An activation for one picture: the name of the module, the hidden state or the tensor, its
    shape, the stride from the picture's side to its own, infinite if it has not four axes of
    floats, and whether the last two axes look like height and width."""

    name: str
    shape: tuple[int, ...]
    stride: float
    is_map: bool

    def __str__(self) -> str:
        return f"{self.name} {self.shape}, stride {self.stride:.3g}"


def find_activations(
    network: nn.Module, numbers: Tensor, names: Sequence[str] | None = None
) -> list[Activation]:
    """The activations of a network that are features, by the rule or by their names, in a run on
    ``numbers``, its input for one picture. An unknown name, one of something else than ``(B, C, h,
    w)`` floats, and no activation by the rule are a ValueError."""
    activations = all_activations(network, numbers)
    if names is None:
        states = [act for act in activations if act.name.startswith(HIDDEN)]
        if chosen := _by_rule(states) or _by_rule(activations):
            return chosen
        raise ValueError(
            f"the encoder has no activation at a stride from {STRIDES[0]} to {STRIDES[1]}; name "
            "one with features: in a YAML file"
        )
    by_name = {act.name: act for act in activations}
    for name in names:
        if name not in by_name:
            near = get_close_matches(name, by_name, n=3, cutoff=0) or ["none"]
            raise ValueError(f"features: no activation {name!r}; the nearest are {', '.join(near)}")
        if math.isinf(by_name[name].stride):
            raise ValueError(
                f"features: expected (B, C, h, w) floats, {name} is {by_name[name].shape}"
            )
    return [by_name[name] for name in names]


def all_activations(network: nn.Module, numbers: Tensor) -> list[Activation]:
    """All activations of a network but its outputs in a run on ``numbers``, in order."""
    size = numbers.shape[2:]
    if isinstance(network, OnnxNetwork):
        return [_activation(name, value, size) for name, value in network.run_all(numbers).items()]
    inner: list[tuple[int, Activation, weakref.ref[Tensor]]] = []

    def note(name: str, call: int, output: Tensor) -> None:
        inner.append((call, _activation(name, output, size), weakref.ref(output)))

    with torch.no_grad(), _hooked(network, note, hidden=True):
        outputs = [leaf for leaf in tree_leaves(network(numbers)) if isinstance(leaf, Tensor)]
    calls = Counter(act.name for _, act, _ in inner)
    states = {act.name: act for call, act, _ in inner if not call}
    return [
        act._replace(name=f"{act.name}{_CALL}{call}") if calls[act.name] > 1 else act
        for call, act, value in inner
        if call and not any(value() is output for output in outputs)
    ] + [*states.values()]


def _by_rule(activations: Sequence[Activation]) -> list[Activation]:
    """The activations of the rule, the finer first; empty if there is none."""
    least, most = STRIDES
    maps = [
        (round(math.log2(act.stride / STRIDE)), act)
        for act in activations
        if act.is_map and least <= act.stride <= most and act.shape[1] > 3  # else it is a picture
    ]
    octaves = {octave for octave, _ in maps}
    if not octaves:
        return []
    target = min(0, max(octaves) - 1)
    best = min(octaves, key=lambda octave: (abs(octave - target), -octave))
    coarser = sorted(octave for octave in octaves if octave > best)
    return [_last_at(octave, maps) for octave in (best, *coarser[:1])]


def _last_at(octave: int, maps: Sequence[tuple[int, Activation]]) -> Activation:
    since = itertools.dropwhile(lambda pair: pair[0] != octave, maps)
    until = itertools.takewhile(lambda pair: pair[0] <= octave, since)
    members = [act for octave_of_map, act in until if octave_of_map == octave]
    widest = max(act.shape[1] for act in members)
    return next(act for act in reversed(members) if 2 * act.shape[1] > widest)


@contextmanager
def captured(network: nn.Module, names: Sequence[str]) -> Iterator[dict[str, Tensor]]:
    """Takes activations of a module while it runs in this thread, whatever other threads run: the
    mapping holds them by name afterwards."""
    values: dict[str, Tensor] = {}
    calls = {_call_of(name): name for name in names}

    def take(module: str, call: int, output: Tensor) -> None:
        if name := calls.get((module, call)):
            values[name] = output.clone()  # a later module may change it in place

    with _hooked(network, take, hidden=any(name.startswith(HIDDEN) for name in names)):
        yield values


def _call_of(name: str) -> tuple[str, int]:
    """The module of an activation and the number of its call, from 1; 0 for a hidden state."""
    module, _, call = name.partition(_CALL)
    return (module, int(call)) if call.isdecimal() else (name, int(not name.startswith(HIDDEN)))


@contextmanager
def _hooked(
    network: nn.Module, take: Callable[[str, int, Tensor], None], hidden: bool
) -> Iterator[None]:
    """Gives ``take`` the name of each module that runs in this thread, the number of the call, and
    its output; with ``hidden`` also hidden states of a published transformer, as call 0."""
    thread, calls = threading.get_ident(), Counter[str]()

    def hook(name: str, _module: nn.Module, _inputs: object, output: object) -> None:
        if isinstance(output, Tensor) and threading.get_ident() == thread:
            calls[name] += 1
            take(name, calls[name], output)

    def ask(_module: nn.Module, inputs: Any, named: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return inputs, {**named, "output_hidden_states": True}

    def take_states(_module: nn.Module, inputs: Any, named: dict[str, Any], result: Any) -> None:
        if threading.get_ident() != thread:
            return
        tensors = (value for value in (*inputs, *named.values()) if isinstance(value, Tensor))
        [picture] = (tensor for tensor in tensors if tensor.ndim == 4)
        states = getattr(result, HIDDEN, None) or getattr(result, f"encoder_{HIDDEN}", None) or ()
        for number, state in enumerate(states):
            take(f"{HIDDEN}.{number}", 0, _map_of(state, *picture.shape[2:]))

    with ExitStack() as stack:
        for name, module in nn.Module.named_modules(network):
            if name:
                stack.callback(module.register_forward_hook(partial(hook, name)).remove)
        modules = nn.Module.modules(network) if hidden else ()
        published = (m for m in modules if hasattr(getattr(m, "config", None), "model_type"))
        if transformer := next(published, None):  # the outermost one
            stack.enter_context(transformer.register_forward_pre_hook(ask, with_kwargs=True))
            stack.enter_context(transformer.register_forward_hook(take_states, with_kwargs=True))
        yield


def _map_of(state: Tensor, height: int, width: int) -> Tensor:
    """Tokens ``(B, N, C)`` of the cells of a picture, after a few more, as ``(B, C, h, w)``."""
    if state.ndim != 3:
        return state
    for extra in range(9):
        cells = state.shape[1] - extra
        rows = round(math.sqrt(max(1, cells) * height / width))
        if rows and rows * (cells // rows) == cells and rows * width == cells // rows * height:
            cut: Tensor = state[:, extra:].transpose(1, 2).unflatten(2, (rows, -1))
            return cut
    return state


def _activation(name: str, value: Tensor, size: Sequence[int]) -> Activation:
    shape = tuple(value.shape)
    if len(shape) != 4 or not value.is_floating_point() or not shape[2] * shape[3]:
        return Activation(name, shape, math.inf, False)
    strides = [picture / side for picture, side in zip(size, shape[2:], strict=True)]
    is_map = shape[2] == shape[3] or max(strides) < _UNEVEN * min(strides)
    return Activation(name, shape, math.sqrt(math.prod(strides)), is_map)
