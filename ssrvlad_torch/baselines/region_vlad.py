"""Region-VLAD (Khaliq, Ehsan, Chen, Milford, McDonald-Maier, T-RO 2019).

The network is Caffe's AlexNet of Places365 up to conv3 (Zhou et al., TPAMI 2018): the authors'
vocabulary holds its activations. That which Places365 publishes for PyTorch is another network."""

import pickle
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..channels.channel import View, picture_of
from ..files import naming, requiring
from .channel_methods import VectorMethod
from .weights import fill, find_weights

_MEAN_BGR = (104.051, 112.514, 116.676)  # the mean pixel of places365CNN_mean.binaryproto


class RegionVLAD(VectorMethod):
    """VLAD of a picture's regions over a vocabulary, compared by the cosine. ``regions`` and
    ``words`` are N and V of the paper. `find_weights` finds the published files. It needs the extra
    ``eval``."""

    name = "region-vlad"
    needs = frozenset({"images", "weights"})

    def __init__(
        self,
        weights: str | Path | None = None,
        vocabulary: str | Path | None = None,
        regions: int = 400,
        words: int = 256,
    ) -> None:
        self._regions = regions
        path = find_weights(weights, ["alexnet_places365.caffemodel"], "the Places365 project")
        with torch.device("meta"):
            self._network = AlexNetPlaces365().eval()
        fill(self._network, read_caffe(path), path)
        origin = "github.com/Ahmedest61/CNN-Region-VLAD-VPR"
        path = find_weights(vocabulary, [f"Vocabulary_{regions}.pkl"], origin)
        self._words = read_vocabulary(path, (str(regions), str(words), "conv3"), (words, 384))
        self.shape = (self._words.numel(),)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        pictures = [torch.tensor(picture_of(view, self.name)).permute(2, 0, 1) for view in views]
        maps = (self._network(picture[None])[0] for picture in pictures)
        return torch.stack(
            [vlad(regions_of(planes, self._regions), self._words) for planes in maps]
        )


class AlexNetPlaces365(nn.Module):
    """Three convolutions with Caffe's names, on pixels in the order blue, green, red. ``(B, 3, H,
    W)`` RGB from 0 to 255 give ``(B, 384, 13, 13)`` float32."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 96, 11, stride=4)
        self.conv2 = nn.Conv2d(96, 256, 5, padding=2, groups=2)
        self.conv3 = nn.Conv2d(256, 384, 3, padding=1)
        self.pool = nn.Sequential(nn.MaxPool2d(3, stride=2), nn.LocalResponseNorm(5, 1e-4, 0.75))

    def forward(self, images: Tensor) -> Tensor:
        """The maps of conv3 of each image."""
        small = F.interpolate(images.float(), (227, 227), mode="bilinear", align_corners=False)
        x = small.flip(1) - small.new_tensor(_MEAN_BGR)[:, None, None]
        x = self.pool(F.relu(self.conv2(self.pool(F.relu(self.conv1(x))))))
        return F.relu(self.conv3(x))


def regions_of(maps: Tensor, count: int) -> Tensor:
    """The descriptors ``(R, C)`` float32 of at most ``count`` regions by falling mean activation,
    of maps ``(C, H, W)`` from 0. A region is 8-connected places of one map with the same integer
    part, not 0, as in the authors' program; its descriptor sums all maps over its bounding box."""
    with requiring("eval", "region-vlad needs"):
        from scipy import ndimage
        from skimage.measure import label
    activations = maps.double().numpy(force=True)
    levels = activations.astype(np.int64)
    apart = np.arange(len(levels))[:, None, None] * (levels.max(initial=0) + 1)  # maps do not join
    numbers, total = label(np.where(levels > 0, levels + apart, 0), return_num=True, connectivity=3)
    energy = np.asarray(ndimage.mean(activations, numbers, np.arange(1, total + 1)))
    rank = np.zeros(total + 1, int)
    rank[1 + np.argsort(-energy, kind="stable")[:count]] = np.arange(1, min(count, total) + 1)
    boxes = ndimage.find_objects(rank[numbers])
    sums = [activations[:, rows, columns].sum((1, 2)) for _, rows, columns in boxes]
    return torch.tensor(np.array(sums, np.float32).reshape(-1, len(maps)))


def vlad(descriptors: Tensor, words: Tensor) -> Tensor:
    """``(R, D)`` descriptors and ``(V, D)`` words give ``(V * D,)`` of length 1, or zeros: sums of
    residuals to the nearest word (Jegou et al., CVPR 2010), with the signed square root."""
    nearest = torch.cdist(descriptors, words).argmin(1)
    residuals = torch.zeros_like(words).index_add_(0, nearest, descriptors - words[nearest])
    return F.normalize((residuals.sign() * residuals.abs().sqrt()).flatten(), dim=0)


def read_caffe(path: Path) -> dict[str, Tensor]:
    """Weights and biases of a ``.caffemodel``, as ``LAYER.weight`` and ``LAYER.bias``; a damaged
    file is a ValueError. It needs the extra ``onnx``, which brings protobuf."""
    with requiring("onnx", "a .caffemodel needs"):
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
    pool = descriptor_pool.DescriptorPool()
    form = resources.files(__package__).joinpath("caffe.textproto").read_text("utf-8")
    pool.Add(text_format.Parse(form, descriptor_pb2.FileDescriptorProto()))
    make = message_factory.GetMessageClass(pool.FindMessageTypeByName("caffe.Net"))
    with naming(f"{path} is no whole .caffemodel"):
        return {
            f"{layer.name}.{kind}": torch.tensor(blob.data).reshape(*blob.shape.dim)
            for layer in make.FromString(path.read_bytes()).layer
            for kind, blob in zip(("weight", "bias"), layer.blobs, strict=False)
        }


def read_vocabulary(path: Path, keys: Sequence[str], shape: tuple[int, int]) -> Tensor:
    """The centres of a k-means of scikit-learn in a pickle of nested dictionaries with these keys,
    float32; a ValueError for another file. Of a pickle only arrays and empty objects are made."""
    with naming(f"{path} is no vocabulary"):
        with path.open("rb") as file:
            content = _Arrays(file, encoding="latin1").load()
        for key in keys:
            content = {str(name): value for name, value in content.items()}[key]
        words = torch.from_numpy(content.cluster_centers_.astype(np.float32))
        if words.shape != shape or not words.isfinite().all():
            raise ValueError(f"expected {shape} finite numbers, got {tuple(words.shape)}")
    return words


class _Attributes:
    """Stands for an object of any class, with its attributes."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            vars(self).update(state)


_READ = {
    "_reconstruct": np.zeros(0).__reduce__()[0],
    "scalar": np.float64(0).__reduce__()[0],
    "ndarray": np.ndarray,
    "dtype": np.dtype,
    "encode": lambda text, _: text.encode("latin1"),
}
"""What is called of a pickle: what makes an array."""


class _Arrays(pickle.Unpickler):
    """Reads arrays; whatever else a pickle names is `_Attributes`."""

    def find_class(self, _module: str, name: str) -> Any:
        """See `pickle.Unpickler`."""
        return _READ.get(name, _Attributes)
