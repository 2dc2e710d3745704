"""Fuse: a segmentation network and the head in one ONNX file, from pictures to places."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..files import check_output, replacing
from ..onnx_files import graph_digest, load_model, open_session, save_model
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.segmenter import Segmenter
from .export import head_model
from .golden import outputs_of
from .label_graph import join, label_graph, opset, raised
from .metadata import PREFIX, SEAL, Metadata, seal

if TYPE_CHECKING:
    import onnx

Arrays = Mapping[str, npt.NDArray[Any]]

NETWORK = f"{PREFIX}network"
HEAD_GOLDEN = f"{PREFIX}head_golden"

IMAGE, LABELS = "image", "labels"
HEAD = "ssrvlad/"
"""Before the names of the head's nodes and tables."""

MOST_OTHER_PIXELS = 0.01
"""Fraction of a golden image's pixels that may get another label where the network is computed in
another order: by another library, or on another processor."""

_SIZES = ((96, 128), (224, 448), (512, 512), (512, 1024), (1024, 2048))
"""Sizes of a golden image: small, and those that networks are often made for."""

_PATCHES = 40
_COLOUR_STEPS = 8


@dataclass(frozen=True)
class FusedNetwork:
    """What a fused file says about the network in it.

    Attributes:
        name: as it was given, of a file without its folder.
        key: of what it computes and of its settings; see `Segmenter.key`.
        settings: how pictures are prepared, as `SegmenterConfig`.
    """

    name: str
    key: str
    settings: dict[str, Any]


def fuse(
    network: Segmenter | str | Path,
    config: SSRVLADConfig,
    path: str | Path,
    head_path: str | Path | None = None,
) -> FusedNetwork:
    """Joins a segmentation network and the head in one ONNX file that runs on the CPU in ONNX
    Runtime with nothing else; or writes the two parts, so that the network can run on an
    accelerator and the head on the CPU.

    Everything is in it: what is done to pictures, the network, the decision which class wins, and
    the head. It labels pictures as `Segmenter` does, and describes label maps as `SSRVLAD`; it is
    run on a golden image before it takes its place, and must agree with both.

    Shape:
        - input: ``image (B, H, W, 3)`` uint8 in RGB, of any size.
        - outputs: those of `export_head`, and ``labels (B, H, W)`` uint8, or int64 for wider ids;
          of the network's part ``labels`` alone, which is the input of the head's.

    Args:
        network: a segmenter, or the name of a network; see `open_network`.
        config: the settings of the head; ``labels_as`` is the label space of the network.
        path: the file; what was there is replaced, whole or not at all. Beyond 2 GB the weights
            go to a file beside it.
        head_path: the file of the head, if it is to be one of its own: `path` then takes pictures
            to label maps.

    Raises:
        ValueError: the network cannot be traced, run or raised to opset 18, does not fit the
            label space, or has a head already.
        ImportError: a missing extra.
        OSError: the file cannot be written.
    """
    segmenter = network
    if not isinstance(segmenter, Segmenter):
        segmenter = Segmenter.load(segmenter, config.labels_as)
    name = _name(segmenter, network)
    apart = Path(head_path) if head_path else None
    try:
        return _fuse(segmenter, name, config, Path(path), apart)
    except ValueError as error:
        raise ValueError(str(error) if name in str(error) else f"{name}: {error}") from error


def _name(segmenter: Segmenter, given: Segmenter | str | Path) -> str:
    if not isinstance(given, Segmenter):
        return Path(given).name if Path(given).exists() else str(given)
    network = segmenter.network
    return network.path.name if isinstance(network, OnnxNetwork) else type(network).__name__


def _fuse(
    segmenter: Segmenter, name: str, config: SSRVLADConfig, path: Path, head_path: Path | None
) -> FusedNetwork:
    head = SSRVLAD(config)
    if segmenter.label_space != head.label_space:
        raise ValueError(
            f"gives labels of {segmenter.label_space.name}, the head reads {head.label_space.name}"
        )
    if isinstance(segmenter.network, OnnxNetwork):
        properties = load_model(segmenter.network.path).metadata_props
        if any(entry.key.startswith(PREFIX) for entry in properties):
            raise ValueError("has a head already; expected the network alone")
    images, labels = _golden_image(segmenter)
    model = label_graph(segmenter.labels)
    (output,) = model.graph.output
    dtype = "uint8" if output.type.tensor_type.elem_type == _UINT8 else "int64"
    head_alone = head_model(config, LABELS, dtype)
    fused = FusedNetwork(name, segmenter.key(), dataclasses.asdict(segmenter.config))
    extra = {NETWORK: json.dumps(asdict(fused))}
    if head_path is None:
        model = _joined(model, head_alone)
        alone = Metadata.from_properties({e.key: e.value for e in head_alone.metadata_props})
        extra[HEAD_GOLDEN] = json.dumps(alone.golden)
    graph, interface = graph_digest(model), _interface(model)

    def describe(file: Path) -> dict[str, str]:
        golden = _golden(open_session(file, file.name), images, labels, head)
        metadata = Metadata.of(head.config, head.label_space, interface, golden)
        properties = metadata.to_properties() | extra
        return {**properties, SEAL: seal(graph, properties)}

    if head_path:
        check_output(head_path)
    save_model(model, path, describe)
    if head_path:
        with replacing(head_path) as temporary:
            temporary.write_bytes(head_alone.SerializeToString())
    return fused


_UINT8 = 2


def _joined(labels: onnx.ModelProto, head: onnx.ModelProto) -> onnx.ModelProto:
    """Pictures to label maps and descriptors."""
    kept = labels.graph.output[0]
    head = raised(head, opset(labels))
    given = head.graph.input[0].name
    model = join([labels, head], ["", HEAD], [[(LABELS, f"{HEAD}{given}")]])
    model.graph.output.append(kept)
    return model


def _golden_image(segmenter: Segmenter) -> tuple[npt.NDArray[np.uint8], npt.NDArray[Any]]:
    """Pictures of the smallest usual size that the network takes, and their label maps."""
    network, error = segmenter.network, ValueError("takes no picture")
    count = (network.batch if isinstance(network, OnnxNetwork) else None) or 1
    for height, width in _SIZES:
        images = _patches((count, height, width))
        try:
            return images, np.stack(segmenter(list(images)))
        except ValueError as reason:
            error = reason
    raise error


def _golden(
    session: Any, images: npt.NDArray[np.uint8], labels: npt.NDArray[Any], head: SSRVLAD
) -> Arrays:
    """The golden image, the labels that the graph gives it, and what the module makes of those if
    the head is in the graph.

    Raises:
        ValueError: the graph does not label it as the segmenter does, or the head disagrees.
    """
    outputs = run_by_name(session, {IMAGE: images})
    fraction = float((outputs[LABELS] != labels).mean())
    if fraction > MOST_OTHER_PIXELS:
        raise ValueError(f"labels {fraction:.1%} of a golden image otherwise once it is fused")
    golden = {IMAGE: images, LABELS: outputs[LABELS]}
    if len(outputs) == 1:
        return golden
    result = outputs_of(head, outputs[LABELS])
    for name, array in result.items():
        if not np.allclose(outputs[name], array, rtol=0, atol=1e-6):
            raise ValueError(f"the fused head gives another {name} than the PyTorch module")
    return golden | result


def run_by_name(session: Any, inputs: Arrays) -> dict[str, npt.NDArray[Any]]:
    """All outputs of a session by name."""
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, dict(inputs)), strict=True))


def _interface(model: onnx.ModelProto) -> dict[str, Any]:
    return {
        "opset": opset(model),
        "inputs": dict(map(_form, model.graph.input)),
        "outputs": dict(map(_form, model.graph.output)),
    }


def _form(value: onnx.ValueInfoProto) -> tuple[str, dict[str, Any]]:
    from onnx import helper

    kind = value.type.tensor_type
    shape = [axis.dim_param or axis.dim_value or None for axis in kind.shape.dim]
    return value.name, {
        "dtype": helper.tensor_dtype_to_np_dtype(kind.elem_type).name,
        "shape": shape,
    }


def _patches(shape: tuple[int, int, int]) -> npt.NDArray[np.uint8]:
    """``(B, H, W, 3)``: every pixel has the colour of the nearest of some random points. Few
    colours, so that it compresses well."""
    _, height, width = shape
    rng = np.random.default_rng(0)
    images = np.empty((*shape, 3), np.uint8)
    rows, columns = np.mgrid[:height, :width]
    for image in images:
        y, x = rng.uniform(0, height, _PATCHES), rng.uniform(0, width, _PATCHES)
        nearest = np.zeros((height, width), np.int64)
        least = np.full((height, width), np.inf)
        for point in range(_PATCHES):
            distance = np.hypot(rows - y[point], columns - x[point])
            nearest[distance < least] = point
            least = np.minimum(least, distance)
        colours = rng.integers(0, _COLOUR_STEPS + 1, (_PATCHES, 3)) * 255 // _COLOUR_STEPS
        image[:] = colours[nearest]
    return images
