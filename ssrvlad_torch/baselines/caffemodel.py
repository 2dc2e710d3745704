"""Networks that Caffe saved: the arrays of a ``.caffemodel``, read by Google's protobuf, which
skips what `_MESSAGES` does not define."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..files import requiring

_MESSAGES = {
    "BlobShape": {"dim": (1, "repeated int64")},
    "BlobProto": {
        **{name: (number, "int32") for number, name in enumerate(("num", "c", "h", "w"), 1)},
        "data": (5, "repeated float"),
        "shape": (7, "BlobShape"),
    },
    "V1LayerParameter": {"name": (4, "string"), "blobs": (6, "repeated BlobProto")},
    "LayerParameter": {"name": (1, "string"), "blobs": (7, "repeated BlobProto")},
    "NetParameter": {
        "layers": (2, "repeated V1LayerParameter"),
        "layer": (100, "repeated LayerParameter"),
    },
}
"""Messages of ``caffe.proto`` that hold weights, of layers of before 2015 and of today: the number
and the type of each field."""


def read_caffemodel(path: Path) -> dict[str, Tensor]:
    """The arrays ``<layer>.weight`` and ``<layer>.bias`` float32 of a Caffe network, in Caffe's
    shapes: a convolution's is ``(out, in / groups, h, w)``, as in PyTorch. Another or a damaged
    file is a ValueError, no protobuf an ImportError."""
    network, damaged = _network_message()
    try:
        network.ParseFromString(path.read_bytes())
        tensors = dict[str, Tensor]()
        for layer in (*network.layers, *network.layer):
            for kind, blob in zip(("weight", "bias"), layer.blobs, strict=False):
                shape = list(blob.shape.dim) or [blob.num, blob.c, blob.h, blob.w]
                while not blob.shape.dim and len(shape) > 1 and shape[0] == 1:
                    shape.pop(0)  # before 2015 there are always four sizes; a leading 1 is no axis
                array = torch.from_numpy(np.array(blob.data, np.float32))
                tensors[f"{layer.name}.{kind}"] = array.reshape(shape)
    except (damaged, RuntimeError) as error:
        raise ValueError(f"{path} is not a whole Caffe network: {error}") from error
    if not tensors:
        raise ValueError(f"{path} is not a Caffe network: it has no layer with weights")
    return tensors


def _network_message() -> tuple[Any, type[Exception]]:
    """An empty ``NetParameter``, and the error that it raises for damaged bytes."""
    with requiring("eval", "Caffe's files need"):
        from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
        from google.protobuf.descriptor_pb2 import FileDescriptorProto
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass
    file = FileDescriptorProto(name="caffe.proto", package="caffe", syntax="proto2")
    for message, fields in _MESSAGES.items():
        added = file.message_type.add(name=message)
        for name, (number, words) in fields.items():
            many, _, kind = words.rpartition(" ")
            field = added.field.add(name=name, number=number)
            field.label = Field.LABEL_REPEATED if many else Field.LABEL_OPTIONAL
            if kind in _MESSAGES:
                field.type, field.type_name = Field.TYPE_MESSAGE, f".caffe.{kind}"
            else:
                field.type = Field.Type.Value(f"TYPE_{kind.upper()}")
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("caffe.NetParameter"))(), DecodeError
