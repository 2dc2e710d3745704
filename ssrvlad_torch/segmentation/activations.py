"""Activations inside a network: which of them are features, and taking them while it runs.

Features are the encoder's last activation at the target stride, and the last at the next coarser
stride, if there is one. The target is stride 8, or half the coarsest stride if that is finer, or
else the nearest that there is. The encoder ends where an operator raises the resolution: where a
map has at least twice as many cells as before. Activations with at most half the channels of the
widest of their stride belong to the step to the next stride and do not count.

An activation has the name of its module, and of a module that runs several times ``NAME#CALL``:
``act#2`` is the output of the second call.
"""

import itertools
import math
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from difflib import get_close_matches
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakTensorKeyDictionary

from .onnx_network import OnnxNetwork

STRIDE, STRIDES = 8, (4, 32)
"""The coarsest stride that is sought, and the smallest and the largest that are near enough."""

HIDDEN = "hidden_states"
"""What the names of the activations of a transformer begin with."""

_CALL = "#"

_RAISING = ("upsample", "convolution", "pixel_shuffle", "unpool", "grid_sampler")
_RAISING_NODES = ("Resize", "Upsample", "ConvTranspose", "DepthToSpace", "MaxUnpool", "GridSample")
_UNEVEN = 1.5
"""The last axes of a tensor whose strides differ by this factor are not the height and width of a
map, but of one with the channels last; unless they are equal, as where a network first makes every
picture a square."""


class Activation(NamedTuple):
    """An activation for one picture: the name of the module, the hidden state or the tensor, its
    shape, the stride from the picture's side to its own, infinite if it has not four axes of
    floats, whether the last two axes look like height and width, and whether it depends on an
    operator that raised the resolution."""

    name: str
    shape: tuple[int, ...]
    stride: float
    is_map: bool
    raised: bool = False

    def __str__(self) -> str:
        return f"{self.name} {self.shape}, stride {self.stride:.3g}"


def find_activations(
    network: nn.Module, numbers: Tensor, names: Sequence[str] | None = None
) -> list[Activation]:
    """The activations of a network that are features, by the rule or by their names, in a run on
    ``numbers``, its input for one picture, ``(1, 3, H, W)`` or of the layout of the graph. A name
    that is unknown or of something else than ``(B, C, h, w)`` floats, an encoder without an
    activation at a stride that is near enough, and, without names, a network with a part in
    TorchScript, whose activations cannot be taken, are a ValueError."""
    if names is None and any(map(is_script, network.modules())):
        raise ValueError("the activations of a TorchScript module cannot be taken")
    found = all_activations(network, numbers)
    if names is None:
        states = [each for each in found if each.name.startswith(HIDDEN)]
        if chosen := _chosen(states) or _chosen(found):
            return chosen
        raise ValueError(
            f"the encoder has no activation at a stride from {STRIDES[0]} to {STRIDES[1]}; name "
            "one with features: in a YAML file"
        )
    by_name = {each.name: each for each in found}
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
    """All activations of a network in a run on ``numbers``, in order, those that cannot be features
    too; see `find_activations`."""
    if isinstance(network, OnnxNetwork):
        return _of_graph(network, numbers)
    return _of_module(network, numbers)


def _chosen(found: Sequence[Activation]) -> list[Activation]:
    """The activations of the rule, the finer first; empty if there is none."""
    least, most = STRIDES
    encoder = [
        (round(math.log2(each.stride / STRIDE)), each)
        for each in found
        if not each.raised
        and each.is_map
        and least <= each.stride <= most
        and each.shape[1] > 3  # else it is a smaller picture
    ]
    if not encoder:
        return []
    octaves = {octave for octave, _ in encoder}
    target = min(0, max(octaves) - 1)
    best = min(octaves, key=lambda octave: (abs(octave - target), -octave))
    coarser = [octave for octave in octaves if octave > best]
    return [_last_at(octave, encoder) for octave in (best, *sorted(coarser)[:1])]


def _last_at(octave: int, encoder: Sequence[tuple[int, Activation]]) -> Activation:
    """The last activation of an octave, before a coarser one begins, that is not narrow."""
    since = itertools.dropwhile(lambda pair: pair[0] != octave, encoder)
    until = itertools.takewhile(lambda pair: pair[0] <= octave, since)
    members = [each for own, each in until if own == octave]
    widest = max(each.shape[1] for each in members)
    return next(each for each in reversed(members) if 2 * each.shape[1] > widest)


@contextmanager
def taken(network: nn.Module, names: Sequence[str]) -> Iterator[dict[str, Tensor]]:
    """Takes activations of a module while it runs in this thread, whatever others run: the mapping
    holds them by name afterwards."""
    values: dict[str, Tensor] = {}
    wanted = {_call_of(name): name for name in names}

    def take(module: str, call: int, output: Tensor) -> None:
        if name := wanted.get((module, call)):
            values[name] = output.clone()  # a later module may change it in place

    modules = {module for module, _ in wanted}
    with _hooked(network, take, modules), ExitStack() as stack:
        if any(name.startswith(HIDDEN) for name in names):
            stack.enter_context(_hidden_states(network, values))
        yield values


def _call_of(name: str) -> tuple[str, int]:
    """The module of an activation and the number of its call, from 1."""
    module, _, call = name.partition(_CALL)
    return (module, int(call)) if call.isdecimal() else (name, 1)


def is_script(module: nn.Module) -> bool:
    """Whether a module is in TorchScript."""
    return isinstance(module, torch.jit.ScriptModule)


@contextmanager
def _hooked(
    network: nn.Module,
    take: Callable[[str, int, Tensor], None],
    names: Collection[str] | None = None,
) -> Iterator[None]:
    """Gives the names of modules, or of those named, that run in this thread, the number of the
    call, and its output. A module in TorchScript takes no hooks."""
    own, calls = threading.get_ident(), Counter[str]()

    def hook(name: str, _module: nn.Module, _inputs: object, output: object) -> None:
        if isinstance(output, Tensor) and threading.get_ident() == own:
            calls[name] += 1
            take(name, calls[name], output)

    with ExitStack() as stack:
        for name, module in network.named_modules():
            if name and (names is None or name in names) and not is_script(module):
                stack.callback(module.register_forward_hook(partial(hook, name)).remove)
        yield


@contextmanager
def _hidden_states(network: nn.Module, values: dict[str, Tensor]) -> Iterator[None]:
    """Takes the hidden states of the encoder of a published transformer, as ``(B, C, h, w)``."""
    own = threading.get_ident()
    modules = network.modules()  # of which the outermost published transformer is taken
    of_type = (m for m in modules if hasattr(getattr(m, "config", None), "model_type"))
    if (transformer := next(of_type, None)) is None:
        yield
        return

    def ask(_module: nn.Module, inputs: Any, named: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return inputs, {**named, "output_hidden_states": True}

    def take(_module: nn.Module, inputs: Any, named: Mapping[str, Any], result: Any) -> None:
        if threading.get_ident() != own:
            return
        given = (each for each in (*inputs, *named.values()) if isinstance(each, Tensor))
        [picture] = (each for each in given if each.ndim == 4)
        states = getattr(result, HIDDEN, None) or getattr(result, f"encoder_{HIDDEN}", None) or ()
        for number, state in enumerate(states):
            values[f"{HIDDEN}.{number}"] = _map_of(state, *picture.shape[2:])

    before = transformer.register_forward_pre_hook(ask, with_kwargs=True)
    after = transformer.register_forward_hook(take, with_kwargs=True)
    with before, after:  # are removed at the end
        yield


def _map_of(state: Tensor, height: int, width: int) -> Tensor:
    """Tokens ``(B, N, C)`` of the cells of a picture, after a few others, as ``(B, C, h, w)``."""
    if state.ndim != 3:
        return state
    for extra in range(9):
        cells = state.shape[1] - extra
        rows = round(math.sqrt(max(1, cells) * height / width))
        if rows and rows * (cells // rows) == cells and rows * width == cells // rows * height:
            cut: Tensor = state[:, extra:].transpose(1, 2).unflatten(2, (rows, -1))
            return cut
    return state


def _of_module(network: nn.Module, numbers: Tensor) -> list[Activation]:
    """All activations of one run but the output, in order."""
    size, states = numbers.shape[2:], dict[str, Tensor]()
    seen: list[tuple[Activation, weakref.ref[Tensor]]] = []
    operators, calls = _Operators(), Counter[str]()

    def note(name: str, call: int, output: Tensor) -> None:
        calls[name] = call
        activation = _activation(f"{name}{_CALL}{call}", output, size, output in operators.raised)
        seen.append((activation, weakref.ref(output)))

    with torch.no_grad(), _hidden_states(network, states), _hooked(network, note), operators:
        outputs = [each for each in tree_leaves(network(numbers)) if isinstance(each, Tensor)]
    once = {f"{name}{_CALL}1": name for name, count in calls.items() if count == 1}
    found = [
        each._replace(name=once.get(each.name, each.name))
        for each, value in seen
        if not any(value() is output for output in outputs)
    ]
    return [*found, *(_activation(name, state, size) for name, state in states.items())]


def _of_graph(network: OnnxNetwork, numbers: Tensor) -> list[Activation]:
    nodes, outputs = network.nodes(), network.outputs
    names = [name for node in nodes for name in node.output if name and name not in outputs]
    values = network.run_all(numbers, names)
    size = numbers.shape[1:3] if network.form.channels_last else numbers.shape[2:]
    raised, found = set[str](), list[Activation]()
    for node in nodes:
        ends = (*node.output[:1], *node.input[:1])
        shapes = [values[name].shape for name in ends if name in values]
        raises = node.op_type in _RAISING_NODES and len(shapes) == 2 and is_larger(*shapes)
        if raises or not raised.isdisjoint(node.input):
            raised.update(node.output)
        known = [name for name in node.output if name in values]
        found += [_activation(name, values[name], size, name in raised) for name in known]
    return found


def _activation(name: str, value: Tensor, size: Sequence[int], raised: bool = False) -> Activation:
    shape = tuple(value.shape)
    if len(shape) != 4 or not value.is_floating_point() or not shape[2] * shape[3]:
        return Activation(name, shape, math.inf, False, raised)
    strides = [side / own for side, own in zip(size, shape[2:], strict=True)]
    is_map = shape[2] == shape[3] or max(strides) < _UNEVEN * min(strides)
    return Activation(name, shape, math.sqrt(math.prod(strides)), is_map, raised)


class _Operators(TorchDispatchMode):
    """Notes which tensors depend on a raised resolution, in ``raised``."""

    def __init__(self) -> None:
        super().__init__()
        self.raised = WeakTensorKeyDictionary()

    def __torch_dispatch__(
        self, function: Any, _types: Any, inputs: Any = (), named: Any = None
    ) -> Any:
        result = function(*inputs, **(named or {}))
        tensors = [each for each in tree_leaves((inputs, named)) if isinstance(each, Tensor)]
        inherited = any(each in self.raised for each in tensors)
        can_raise = any(word in function.name() for word in _RAISING)
        for output in tree_leaves(result):
            if isinstance(output, Tensor) and (
                inherited or (can_raise and is_larger(output.shape, tensors[0].shape))
            ):
                self.raised[output] = True
        return result


def is_larger(after: Sequence[int], before: Sequence[int]) -> bool:
    """Whether an operator that makes a map of one shape from another raises the resolution."""
    return len(after) == len(before) == 4 and after[2] * after[3] >= 2 * before[2] * before[3]
