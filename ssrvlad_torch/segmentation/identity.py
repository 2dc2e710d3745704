"""The identity of a network: a digest of everything that determines its output, and whether it
still holds."""

import hashlib
import inspect
import io
from collections.abc import Collection, Iterator
from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn

from .onnx_network import OnnxNetwork


class ChangedError(ValueError):
    """A network is no longer what it was when its digest was taken."""


class Identity:
    """The digest of a network once it is taken, and the versions of weights and persistent buffers
    at that time.

    Comparing versions takes about three milliseconds for a network of 400 modules. They count what
    PyTorch counts: steps of optimizers, ``load_state_dict``, other operators in place, and tensors
    and modules that replace others. What is written through ``tensor.data``, as means of weights
    are, is not counted, so one number of each tensor on a CPU is compared; the next digest sees the
    others. On another device a network is the same.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network, self.digest = network, ""
        self._note()

    def take(self, digest: str) -> None:
        """Takes the first digest; another one is a ChangedError."""
        if not self.digest:
            self.digest = digest
            self._note()
        elif digest != self.digest:
            raise ChangedError(
                "the network has other weights, or gives other labels, than when its label maps "
                "got an identity: make another Segmenter of it"
            )

    def require(self, in_training: Collection[str]) -> None:
        """Raises a ChangedError that names the first tensor that changed, or a module that is in
        training mode and not among those named."""
        if (now := _versions(self.network)) != self._then:
            if self.digest and _device(self.network) == self._device:
                names = (name for name in self._then | now if self._then.get(name) != now.get(name))
                raise ChangedError(
                    "the network was changed after its label maps got an identity "
                    f"({next(names)}): make another Segmenter of it"
                )
            self._note()
        if others := [name for name in training(self.network) if name not in in_training]:
            raise ChangedError(
                f"the network is in training mode ({others[0] or 'the whole'}), where labels "
                "differ: call eval() on it"
            )

    def _note(self) -> None:
        self._held = [*self.network.modules(), *_tensors(self.network)]  # no id is used again
        self._device, self._then = _device(self.network), _versions(self.network)


def training(network: nn.Module) -> list[str]:
    """The names of the modules that are in training mode."""
    return [name for name, module in network.named_modules() if getattr(module, "training", False)]


def digest_of(network: nn.Module, probe: bytes) -> str:
    """A digest in hex that differs between networks.

    It covers the files of an ONNX graph and the program of a frozen module. For other modules it
    covers the code of the classes, their plain attributes, weights and buffers, and ``probe``, the
    network's output for one picture, which depends on the rest. Any edit of such a class, a comment
    too, changes the digest, and with it the keys of databases and caches.
    """
    if isinstance(network, OnnxNetwork):
        return network.digest()
    content = hashlib.blake2b(digest_size=16)
    for piece in (*_parts(network), probe):
        content.update(len(piece).to_bytes(8, "little") + piece)
    return content.hexdigest()


def _parts(network: nn.Module) -> Iterator[bytes]:
    sources: dict[type, str] = {}
    for kind in {*map(type, network.modules())}:
        try:
            sources[kind] = inspect.getsource(kind)
        except (OSError, TypeError):  # the class was typed at a prompt
            sources[kind] = str(kind)
    for name, module in network.named_modules():
        if isinstance(module, torch.jit.ScriptModule):
            file = io.BytesIO()
            torch.jit.save(module, file)
            yield file.getvalue()
            continue
        plain = {k: v for k, v in vars(module).items() if _is_plain(v) and k != "training"}
        yield f"{name} {sources[type(module)]} {module.extra_repr()} {plain}".encode()
    for name, tensor in chain(network.named_parameters(), network.named_buffers()):
        yield f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode()
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        yield flat.view(torch.uint8).numpy().tobytes()


def _tensors(network: nn.Module) -> Iterator[Tensor]:
    return chain(network.parameters(), network.buffers())


def _device(network: nn.Module) -> torch.device | None:
    return next((tensor.device for tensor in _tensors(network)), None)


def _versions(network: nn.Module) -> dict[str, object]:
    """The versions of weights and persistent buffers by name, and which modules there are."""
    versions: dict[str, object] = {}
    for path, module in network.named_modules(remove_duplicate=False):
        prefix, transient = path and f"{path}.", module._non_persistent_buffers_set
        for name, tensor in chain(module._parameters.items(), module._buffers.items()):
            if name not in transient:
                versions[prefix + name] = _version(tensor)
        versions[path] = id(module)
    return versions


def _version(tensor: Tensor | None) -> object:
    if tensor is None:
        return None
    counted = -1 if tensor.is_inference() else tensor._version
    return id(tensor), counted, tensor.dtype, _a_number(tensor)


def _a_number(tensor: Tensor) -> str:
    """The number in the middle of a plain tensor in the memory of this machine, as text."""
    plain = type(tensor) in (Tensor, nn.Parameter) and tensor.layout == torch.strided
    if not (plain and tensor.device.type == "cpu" and tensor.numel()):
        return ""
    return str(tensor.detach()[tuple(length // 2 for length in tensor.shape)].item())


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(map(_is_plain, value))
    return isinstance(value, str | int | float | bool | torch.dtype | None)
