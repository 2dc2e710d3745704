"""Fuse: a segmentation network and the head in one ONNX file, from pictures to descriptors."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from ..channels.channel import View
from ..channels.hog import HOG
from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..files import check_output, flush, one_line, parse_json, replacing, requiring
from ..segmentation.features import PROBES
from ..segmentation.onnx_files import load_model
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.segmenter import Segmenter
from .differences import FEATURES, IMAGE, LABELS, difference_of, problem_of_network
from .export import head_model
from .golden import outputs_of, photograph
from .label_graph import label_graph
from .metadata import PREFIX, Arrays, Metadata
from .runtimes import Run, runtime_of
from .trace import interface, join, opset, with_opset

if TYPE_CHECKING:
    import onnx

NETWORK = f"{PREFIX}network"
"""The property of a fused file that holds its `FusedNetwork`."""

OF_PICTURES = (FEATURES, HOG.name)
"""Channels of a fused file, in which they are outputs and properties with their fingerprints."""

HEAD = "ssrvlad/"
"""Prefix of the names of the head's nodes and tables."""


MAX_FILE_BYTES = (1 << 31) - (1 << 20)
"""Size limit of one file: protobuf's 2 GiB, less 1 MiB for the metadata."""

STEPS = 4
"""Of `fuse`: the golden image, the network, the head, the file."""


@dataclass(frozen=True)
class FusedNetwork:
    """The network in a fused file.

    Attributes:
        name: name of the network; of a file, its name without the folder.
        key: digest of what it computes and of its settings; see `Segmenter.key`.
        settings: the settings of the preparation, as `SegmenterConfig`.
        features, hog: fingerprints of the channels in the file, as in a database; empty without.
    """

    name: str
    key: str
    settings: dict[str, Any]
    features: str = ""
    hog: str = ""

    @property
    def channels(self) -> dict[str, str]:
        """The fingerprints of `OF_PICTURES` in the file."""
        return {name: key for name in OF_PICTURES if (key := getattr(self, name))}


def network_in(properties: Mapping[str, str]) -> FusedNetwork | None:
    """The network in a file, by its properties; ``None`` for a head alone."""
    text = properties.get(NETWORK)
    return FusedNetwork(**parse_json(text, NETWORK)) if text else None


def fuse(
    network: Segmenter | str | Path,
    config: SSRVLADConfig,
    path: str | Path,
    head_path: str | Path | None = None,
    features: bool | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> FusedNetwork:
    """Joins a segmentation network and the head in one ONNX file, or writes them as two, so that
    the network can run on an accelerator and the head on the CPU. The file is run on a golden
    image, and must agree with `Segmenter` and `SSRVLAD`, before it is saved.

    Shape:
        - input: ``image (B, H, W, 3)`` uint8 in RGB, of any size, B at least 1.
        - outputs: those of `export_head`, ``labels (B, H, W)`` uint8, or int64 for wider ids, and
          ``hog (B, 480)`` float32; with features ``features (B, 16, 16, 16)`` uint8, all 0 for
          activations that are not finite or the same everywhere. Of two files, the first gives all
          these, and the second takes the labels.

    Args:
        network: a segmenter, or the name of a network; see `open_network`.
        config: the settings of the head; ``labels_as`` is the label space of the network.
        path: the file; an existing one is replaced. Above 2 GB the weights go to a second file.
        head_path: of two files, that of the head.
        features: whether the file gives features; ``None`` if the network has some, by the rule
            of `find_activations` or by its setting ``features``.
        progress: called with 1 after each of `STEPS` steps.

    Raises:
        ValueError: the network cannot be traced, run or converted to opset 18, does not fit the
            label space, has a head already, or lacks the features that are wanted.
        ImportError: a missing extra.
        OSError: the file cannot be written.
    """
    if isinstance(network, Segmenter):
        segmenter, module = network, network.network
        name = module.path.name if isinstance(module, OnnxNetwork) else type(module).__name__
    else:
        segmenter = Segmenter.load(network, config.labels_as)
        name = Path(network).name if Path(network).exists() else str(network)
    try:
        with requiring("onnx", "ONNX graphs need"):
            from onnx import TensorProto
        extractor = None
        if features or (features is None and not segmenter.problem_of_features):
            extractor = segmenter.features
        head, space = SSRVLAD(config), segmenter.label_space
        if space != head.label_space:
            raise ValueError(
                f"gives labels of {space.name}, the head reads {head.label_space.name}"
            )
        if isinstance(segmenter.network, OnnxNetwork):
            properties = load_model(segmenter.network.path).metadata_props
            if any(entry.key.startswith(PREFIX) for entry in properties):
                raise ValueError("has a head already; expected the network alone")
        expected = _golden_image(segmenter, extractor is not None)
        progress(1)
        model = label_graph(segmenter.labels, extractor)
        progress(1)
        narrow = model.graph.output[0].type.tensor_type.elem_type == TensorProto.UINT8
        head_part = head_model(config, LABELS, "uint8" if narrow else "int64")
        progress(1)
        key = extractor.fingerprint if extractor else ""
        settings, hog = asdict(segmenter.config), HOG().fingerprint
        fused = FusedNetwork(name, segmenter.key(), settings, key, hog)
        extra = {NETWORK: json.dumps(asdict(fused))}
        extra |= {PREFIX + channel: text for channel, text in fused.channels.items()}
        if head_path is None:
            model = _joined(model, head_part)
        form = interface(model)

        def describe(file: Path) -> dict[str, str]:
            golden = _golden(runtime_of().open(file), expected, head, segmenter)
            metadata = Metadata.of(head.config, head.label_space, form, golden)
            return metadata.to_properties() | extra

        if head_path:
            check_output(Path(head_path))
        _save(model, Path(path), describe)
        if head_path:
            with replacing(Path(head_path)) as temporary:
                temporary.write_bytes(head_part.SerializeToString())
        progress(1)
        return fused
    except ValueError as error:
        raise ValueError(str(error) if name in str(error) else f"{name}: {error}") from error


def _save(
    model: onnx.ModelProto, path: Path, describe: Callable[[Path], Mapping[str, str]]
) -> None:
    """Writes an ONNX file, whole or not at all. ``describe`` takes the temporary file and returns
    the metadata properties, or rejects the model. Above `MAX_FILE_BYTES` weights go to a second
    file, whose name holds their digest."""
    import onnx

    path = check_output(path)
    digest, weights_of = hashlib.sha256(), onnx.external_data_helper._get_all_tensors
    for tensor in weights_of(model):
        digest.update(tensor.raw_data)
    size = sum(part.ByteSize() for part in (*model.graph.node, *model.graph.initializer))
    with TemporaryDirectory(prefix=f".{path.name}.", dir=path.absolute().parent) as folder:
        staged = Path(folder) / path.name
        weights = f"{path.name}.{digest.hexdigest()[:16]}.data"
        if size > MAX_FILE_BYTES:
            onnx.external_data_helper.convert_model_to_external_data(
                model, location=weights, size_threshold=1024
            )
        onnx.save_model(model, staged)
        onnx.helper.set_model_props(model, dict(describe(staged)))
        onnx.save_model(model, staged)
        if (external := staged.with_name(weights)).exists():
            flush(external)
            external.replace(path.with_name(weights))
        with replacing(path) as temporary:
            staged.replace(temporary)


def _joined(network: onnx.ModelProto, head: onnx.ModelProto) -> onnx.ModelProto:
    """A network and the head of its labels; the outputs of the head come first."""
    first = list(network.graph.output)
    parts = [network, with_opset(head, opset(network))]
    model = join(parts, ["", HEAD], [[(LABELS, f"{HEAD}{LABELS}")]])
    last = [value for value in model.graph.output if value.name not in OF_PICTURES]
    del model.graph.output[:]
    model.graph.output.extend([*last, *first])
    return model


def head_of(model: onnx.ModelProto) -> onnx.ModelProto:
    """The head in a fused file, by the prefix of its names: `onnx.utils.Extractor` misses the outer
    values that a loop body uses."""
    from onnx import helper

    nodes = [node for node in model.graph.node if node.name.startswith(HEAD)]
    tables = [tensor for tensor in model.graph.initializer if tensor.name.startswith(HEAD)]
    inputs = [value for value in model.graph.output if value.name == LABELS]
    outputs = [v for v in model.graph.output if v.name not in (LABELS, *OF_PICTURES)]
    graph = helper.make_graph(nodes, "ssrvlad", inputs, outputs, tables)
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)


def _golden_image(segmenter: Segmenter, features: bool) -> Arrays:
    """Pictures of the smallest of `PROBES` that the network takes, and what the segmenter says."""
    network, error = segmenter.network, ValueError("takes no picture")
    count = (network.batch if isinstance(network, OnnxNetwork) else None) or 1
    for height, width in sorted(PROBES):
        rng = np.random.default_rng(0)
        pictures = [photograph(rng, height, width) for _ in range(count)]
        try:
            frames = segmenter.segment(pictures, features)
        except ValueError as reason:
            error = reason
            continue
        views = [View("golden", picture=picture) for picture in pictures]
        golden = {IMAGE: np.stack(pictures), LABELS: np.stack([frame.labels for frame in frames])}
        golden[HOG.name] = HOG().describe(views).numpy()
        signs = [frame.features for frame in frames if frame.features is not None]
        return golden | ({FEATURES: np.stack(signs)} if signs else {})
    raise error


def _golden(run: Run, expected: Arrays, head: SSRVLAD, segmenter: Segmenter) -> Arrays:
    """The golden image, what the graph gives it, and the module's outputs for those labels if the
    head is in the graph; a ValueError if the graph disagrees with the segmenter or the module."""
    try:
        outputs = run({IMAGE: expected[IMAGE]})
        problem = problem_of_network(outputs, expected)
    except Exception as error:  # runtimes have no common error type
        problem = f"the graph fails: {one_line(error)}"
    if problem:
        traced = not isinstance(segmenter.network, OnnxNetwork)
        sized = isinstance(segmenter.config.size, tuple)
        hint = (
            "; a network that computes with the size in Python becomes a graph for the traced "
            "size; a fixed size mends it, size: [H, W] in a YAML file"
        )
        raise ValueError(f"of a golden image, {problem}{hint if traced and not sized else ''}")
    golden = {name: outputs.get(name, array) for name, array in expected.items()}
    if "descriptor" not in outputs:
        return golden
    module = outputs_of(head, outputs[LABELS])
    if problem := difference_of(outputs, module)[1]:
        raise ValueError(f"the fused head is not the PyTorch module: {problem}")
    return golden | module
