import threading

import numpy as np
import onnxruntime
import pytest
import torch
from exported import presets
from graphs import session

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.deployment import export
from ssrvlad_torch.deployment.golden import SIZE, golden_pair, outputs_of
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.taxonomy import label_space_names


def pair_of(space: str, given: str = "labels", dtype: str = "uint8"):
    head = SSRVLAD.from_preset("default", labels_as=space)
    return head, golden_pair(head, given, dtype)


@pytest.mark.parametrize("space", label_space_names())
def test_every_id_of_the_space_is_in_the_input_and_one_that_is_not(space):
    head, pair = pair_of(space, dtype="int64")
    assert pair["labels"].shape[1:] == SIZE
    known = {label.id for label in head.label_space.classes}
    (unknown,) = set(np.unique(pair["labels"])) - known
    assert known < set(np.unique(pair["labels"]))
    assert unknown.astype(np.int32) in known, "32 bits do not tell them apart"
    np.testing.assert_array_equal(pair["unknown"], (pair["labels"] == unknown).sum((1, 2)))
    assert pair["unknown"][-1] > 0


def test_unknown_ids_belong_to_no_layer():
    head, pair = pair_of("camvid-11")
    labels = pair["labels"].copy()
    assert labels.max() > 11
    labels[labels > 11] = 11  # void
    np.testing.assert_array_equal(head(labels), pair["descriptor"])
    sweep = SSRVLAD(head.config, (0, 9))
    outputs = outputs_of(sweep, pair["labels"])
    np.testing.assert_array_equal(outputs["descriptor"], sweep(labels))


def test_scores_have_every_class_and_the_outputs_are_the_modules():
    head, pair = pair_of("cityscapes-trainids", "logits")
    assert set(np.unique(pair["logits"].argmax(1))) == set(range(19))
    np.testing.assert_array_equal(pair["descriptor"], head(pair["logits"]))
    assert "keypoints" not in pair
    assert pair["unknown"].tolist() == [0, 0]


def test_the_golden_input_is_changed_by_every_stage():
    """The golden pair can only check the stages that change something."""
    head, pair = pair_of("camvid-32")
    assert head.explain(pair["labels"][:1]).layers.shape[2:] != SIZE
    head = SSRVLAD.from_preset("paper", labels_as="camvid-32")
    view = head.explain(pair["labels"][:1])
    assert not torch.equal(view.layers, view.clean_layers)
    assert view.intersections.any()
    counts = golden_pair(head, "labels", "uint8")["keypoints"]
    np.testing.assert_array_equal(counts[:1], view.keypoints.sum((2, 3)))


OTHERS = {
    "BitwiseAnd": "BitwiseOr",
    "BitwiseOr": "BitwiseAnd",
    "BitwiseXor": "BitwiseOr",
    "Add": "Sub",
    "Sub": "Add",
    "Mul": "Add",
    "Div": "Mul",
    "Less": "GreaterOrEqual",
    "LessOrEqual": "Greater",
    "Greater": "LessOrEqual",
    "GreaterOrEqual": "Less",
    "Min": "Max",
    "Max": "Min",
}
SECONDS = 1
TRIES = 40


def changeable(nodes) -> list:
    """Nodes, also of loops, that `OTHERS` has another operator for."""
    chosen = []
    for node in nodes:
        chosen += [node] if node.op_type in OTHERS else []
        for attribute in node.attribute:
            chosen += changeable(attribute.g.node)
    return chosen


def is_noticed(model, node, inputs, expected) -> bool:
    """Whether another operator in a node changes an output, or stops the graph from running."""
    operator, node.op_type = node.op_type, OTHERS[node.op_type]
    run_options = onnxruntime.RunOptions()
    run_options.log_severity_level = 4
    clock = threading.Timer(SECONDS, setattr, (run_options, "terminate", True))
    try:
        runner = session(model.SerializeToString())
        clock.start()
        got = runner.run(list(expected), inputs, run_options)
    except Exception:
        return True
    finally:
        clock.cancel()
        node.op_type = operator
    return any(
        array.shape != other.shape or np.abs(array - other).max() > 1e-6
        for array, other in zip(got, expected.values(), strict=True)
    )


@pytest.mark.slow
@presets
def test_a_change_of_most_nodes_is_noticed(preset):
    """Some nodes keep a loop within its bounds, correct a rounding that did not happen, or join
    bits that are never both set."""
    model = export.head_model(SSRVLADConfig.from_preset(preset, labels_as="cityscapes-trainids"))
    properties = {entry.key: entry.value for entry in model.metadata_props}
    expected = Metadata.from_properties(properties).golden_arrays()
    inputs = {"labels": expected.pop("labels")}
    nodes = changeable(model.graph.node)
    tried = nodes[:: max(1, len(nodes) // TRIES)]
    assert sum(is_noticed(model, node, inputs, expected) for node in tried) > 0.7 * len(tried)
