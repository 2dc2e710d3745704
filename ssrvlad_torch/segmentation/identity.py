"""The identity of a network: a digest of its file or of its state."""

import hashlib
import io

import torch
from torch import nn

from .onnx_network import OnnxNetwork


def digest_of(network: nn.Module) -> str:
    """A digest in hex: of the files of an ONNX graph, of the program of a module in TorchScript, of
    what ``print`` shows of another module and its ``state_dict()``, on whatever device it is.
    Modules that differ in their code alone have one digest."""
    if isinstance(network, OnnxNetwork):
        return network.digest
    content = hashlib.blake2b(repr(network).encode(), digest_size=16)
    if isinstance(network, torch.jit.ScriptModule):
        file = io.BytesIO()
        torch.jit.save(network, file)
        content.update(file.getvalue())
    for name, tensor in network.state_dict().items():
        content.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        flat = tensor.detach().cpu().contiguous().reshape(-1)
        content.update(flat.view(torch.uint8).numpy())
    return content.hexdigest()
