"""What `verify` reports about correct files and about wrong ones."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from drawings import SPACE
from exported import session, write_space
from helpers import write_street
from onnx import numpy_helper
from PIL import Image

import ssrvlad_torch
from ssrvlad_torch import SSRVLADConfig, export_head
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.deployment.differences import LABELS, difference_of
from ssrvlad_torch.deployment.metadata import PREFIX
from ssrvlad_torch.deployment.runtimes import Runtime, runtime_of
from ssrvlad_torch.deployment.verify import verify

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)


def with_other_root(other: str) -> Runtime:
    """A runtime with another operator in the place of Sqrt; without, it refuses Sqrt."""

    def changed(source):
        model = onnx.load_from_string(source) if isinstance(source, bytes) else onnx.load(source)
        nodes = [node for node in model.graph.node if node.op_type == "Sqrt"]
        assert nodes
        if not other:
            raise RuntimeError("no kernel for Sqrt")
        for node in nodes:
            node.op_type = other
        return runtime_of().open(model.SerializeToString())

    return Runtime("other", changed)


@pytest.fixture(scope="module")
def files(coloured, drives, tmp_path_factory) -> dict[str, Path]:
    """A head for labels, one for class scores, and fused files without and with features; not to
    be changed."""
    folder = tmp_path_factory.mktemp("files")
    heads = {name: folder / f"{name}.onnx" for name in ("labels", "logits")}
    for given, path in heads.items():
        export_head(CONFIG, path, given)
    return {**heads, "fused": coloured / "place.onnx", "features": drives / "place.onnx"}


@pytest.fixture
def streets(tmp_path) -> Path:
    for seed in range(2):
        write_street(tmp_path / "maps" / f"{seed}.png", seed, 90, 120)
    return tmp_path / "maps"


def changed(file: Path, target: Path, change: Callable[[onnx.ModelProto], None]) -> Path:
    """A changed copy."""
    model = onnx.load(file)
    change(model)
    onnx.save(model, target)
    return target


def with_property(name: str, value: Callable[[str], str]) -> Callable[[onnx.ModelProto], None]:
    def change(model: onnx.ModelProto) -> None:
        for entry in model.metadata_props:
            if entry.key == PREFIX + name:
                entry.value = value(entry.value)

    return change


def float_tables(model: onnx.ModelProto) -> list[onnx.TensorProto]:
    kinds = (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)
    return [table for table in model.graph.initializer if table.data_type in kinds]


def edit_table(model: onnx.ModelProto) -> None:
    """Doubles the harmonics' basis: the largest table of floats."""
    table = max(float_tables(model), key=lambda one: np.prod(one.dims))
    array = numpy_helper.to_array(table).copy()
    array.flat[::2] *= 2
    table.CopyFrom(numpy_helper.from_array(array, table.name))


@pytest.mark.parametrize("kind", ["labels", "logits", "fused", "features"])
def test_a_file_that_is_as_it_should_be(kind, files, streets):
    found = verify(files[kind], find_label_files([str(streets)]))
    names = [check.name for check in found.checks]
    golden = "golden pair" if kind in ("labels", "logits") else "golden image"
    assert names == [golden, "maps/0", "maps/1"]
    assert found.passed
    assert found.verdict == "exact"
    assert found.difference < 1e-6
    assert not found.skipped
    assert found.version == ssrvlad_torch.__version__
    assert found.fingerprint == CONFIG.fingerprint
    networks = {"fused": "seg.onnx", "features": "net.yaml"}
    assert found.network == networks.get(kind)
    expected = {
        "features": "16 x 16 cells alike, 128 signs of relu_2, relu_3, "
        if kind == "features"
        else "",
        "hog": "6 x 10 cells, 8 directions" if kind in networks else "",
    }
    for channel, fingerprint in expected.items():
        assert found.channels.get(channel, "").startswith(fingerprint)
        assert (channel in found.channels) == bool(fingerprint)


def edit_bias(model: onnx.ModelProto) -> None:
    (bias,) = (t for t in model.graph.initializer if t.name == "network/bias")
    bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias)[::-1].copy(), bias.name))


def edit_signs(model: onnx.ModelProto) -> None:
    tables = [table for table in float_tables(model) if table.name.startswith("features/")]
    table = max(tables, key=lambda one: np.prod(one.dims))
    table.CopyFrom(numpy_helper.from_array(-numpy_helper.to_array(table), table.name))


def edit_hog(model: onnx.ModelProto) -> None:
    """Another weight of red."""
    [weight] = (
        t for t in model.graph.initializer if numpy_helper.to_array(t).flatten().tolist() == [19595]
    )
    number = numpy_helper.to_array(weight)
    weight.CopyFrom(numpy_helper.from_array(number - number.dtype.type(9999), weight.name))


def edit_table_and_golden(model: onnx.ModelProto) -> None:
    """Also removes the golden outputs."""
    edit_table(model)
    with_property("golden", lambda text: json.dumps({LABELS: json.loads(text)[LABELS]}))(model)


WRONG: dict[str, tuple[str, Callable[[onnx.ModelProto], None], str]] = {
    "table": ("labels", edit_table, r"^descriptors differ by"),
    "golden": ("labels", edit_table_and_golden, r"^descriptors differ by"),
    "network": ("fused", edit_bias, r"of the pixels have another label$"),
    "signs": ("features", edit_signs, r"% of the signs of the features are others$"),
    "hog": ("fused", edit_hog, r"^hog differs by 0\.\d+$"),
    "fingerprint": (
        "labels",
        with_property("fingerprint", lambda _: "0" * 16),
        r"^fingerprint 0000000000000000 is not that of its settings",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_was_changed_in_a_file_is_found(kind, files, ssrvlad, tmp_path):
    name, change, expected = WRONG[kind]
    file = changed(files[name], tmp_path / "edited.onnx", change)
    found = verify(file)
    (problem,) = (check.problem for check in found.checks if check.problem)
    assert re.search(expected, problem)
    assert not found.passed
    code, out, _ = ssrvlad("verify", file)
    assert (code, "WRONG" in out, problem in " ".join(out.split())) == (1, True, True)


def without_metadata(model: onnx.ModelProto) -> None:
    del model.metadata_props[:]


def more_settings(text: str) -> str:
    return json.dumps({**json.loads(text), "colour": 1})


NOT_OURS: dict[str, tuple[Callable[[Any], None], str]] = {
    "no metadata": (without_metadata, "not a file of `ssrvlad export`"),
    "later settings": (with_property("config", more_settings), "unknown setting 'colour'"),
    "no JSON": (with_property("config", lambda _: "{"), "ssrvlad.config is not JSON"),
    "golden": (with_property("golden", lambda text: text.replace('"data": "e', '"data": "f')), ""),
    "label space": (with_property("label_space", lambda _: "{}"), "not a label space"),
}


@pytest.mark.parametrize("kind", NOT_OURS)
def test_a_file_that_is_not_ours_is_one_line(kind, files, refusal, tmp_path):
    change, message = NOT_OURS[kind]
    line = refusal("verify", changed(files["labels"], tmp_path / "x.onnx", change))
    assert message in line and "x.onnx" in line


def test_damaged_files_and_unknown_providers_are_named(files, refusal, tmp_path):
    file, whole = tmp_path / "x.onnx", files["labels"].read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2]):
        file.write_bytes(content)
        assert "x.onnx" in refusal("verify", file)
    line = refusal("verify", files["labels"], "--provider", "Abacus")
    assert "no execution provider 'Abacus'; expected one of" in line


def test_label_maps_that_cannot_be_compared_are_skipped(files, ssrvlad, streets):
    unknown = np.full((9, 9), 200, np.uint8)
    Image.fromarray(unknown).save(streets / "unknown.png")
    np.save(streets / "wide.npy", np.full((9, 9), 300))
    code, out, err = ssrvlad("verify", files["labels"], "--labels", streets, "--json")
    report = json.loads(out)
    assert code == 3
    assert report["passed"]
    assert [check["name"] for check in report["checks"]] == ["golden pair", "maps/0", "maps/1"]
    reasons = {one["frame"]: one["reason"] for one in report["skipped"]}
    assert "label id 200" in reasons["maps/unknown"]
    assert "label id 300; the file takes uint8" in reasons["maps/wide"]
    assert len(err) == 2


RIGHT = {
    "descriptor": np.full((2, 3), 0.5, np.float32),
    "keypoints": np.ones((2, 8), np.int64),
    "unknown": np.zeros(2, np.int64),
}


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("descriptor", lambda array: array + np.float32(9e-7), ""),
        ("descriptor", lambda array: array + np.float32(1e-5), "descriptors differ by 1e-05"),
        ("descriptor", lambda array: array * np.nan, "descriptors differ by inf"),
        ("descriptor", lambda array: array[:, :2], "descriptor is (2, 2), not (2, 3)"),
        ("keypoints", lambda array: array + 1, "keypoints differ"),
        ("unknown", lambda array: array + 1, "unknown differ"),
    ],
)
def test_a_difference_is_named(name, change, problem):
    assert difference_of({**RIGHT, name: change(RIGHT[name])}, RIGHT)[1] == problem


def test_a_label_space_of_its_own_travels_with_the_file(tmp_path):
    space = write_space(tmp_path / "own.yaml", 0, 1, 2)
    export_head(SSRVLADConfig(labels_as=str(space)), tmp_path / "x.onnx", shape=(1, 9, 9))
    [labels] = session((tmp_path / "x.onnx").read_bytes()).get_inputs()
    assert labels.type == "tensor(uint8)", "where no type is asked for"
    space.unlink()
    found = verify(tmp_path / "x.onnx")
    assert found.passed
    assert found.labels_as == "own"


@pytest.mark.parametrize("kind", ["labels", "fused"])
def test_a_runtime_that_is_wrong_or_fails_is_told(kind, files, ssrvlad, monkeypatch):
    """One without roots, and one that cannot take any."""
    for other, verdict in (("Abs", "wrong"), ("", "cannot run")):
        runtime = with_other_root(other)
        monkeypatch.setattr("ssrvlad_torch.deployment.verify.runtime_of", lambda _, r=runtime: r)
        code, out, _ = ssrvlad("verify", files[kind], "--provider", "other", "--json")
        report = json.loads(out)
        assert (code, report["verdict"], report["passed"]) == (1, verdict, False)
        reasons = [check["problem"] for check in report["checks"]]
        assert any("no kernel for Sqrt" in each for each in reasons) == (not other)
