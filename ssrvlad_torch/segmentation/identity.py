"""The identity of a network: a digest of everything that determines its output."""

import hashlib
import inspect
import io
from collections.abc import Iterator
from itertools import chain
from typing import Any

import torch
from torch import nn

from .onnx_network import OnnxNetwork


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
    for part in (*_parts(network), probe):
        content.update(len(part).to_bytes(8, "little") + part)
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


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(map(_is_plain, value))
    return isinstance(value, str | int | float | bool | torch.dtype | None)
