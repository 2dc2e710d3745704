import numpy as np
import pytest

import ssrvlad_torch
from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment.metadata import PREFIX, Metadata
from ssrvlad_torch.taxonomy import LabelSpace, label_space

ARRAYS = {
    "labels": np.arange(6, dtype=np.uint8).reshape(1, 2, 3),
    "descriptor": np.linspace(-1, 1, 7, dtype=np.float32)[None],
    "unknown": np.array([-(2**40)]),
}


def metadata() -> Metadata:
    interface = {"opset": 18, "inputs": {}, "outputs": {}}
    return Metadata.of(SSRVLADConfig(), label_space("camvid-11"), interface, ARRAYS)


def test_properties_are_text_and_come_back():
    properties = metadata().to_properties()
    assert all(isinstance(value, str) for value in properties.values())
    assert Metadata.from_properties({"other": "tool", **properties}) == metadata()
    assert properties[PREFIX + "version"] == ssrvlad_torch.__version__
    assert properties[PREFIX + "fingerprint"] == SSRVLADConfig().fingerprint


def test_golden_arrays_come_back_bit_by_bit():
    back = Metadata.from_properties(metadata().to_properties()).golden_arrays()
    assert list(back) == sorted(ARRAYS)
    for name, array in ARRAYS.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)


def test_the_label_space_is_whole():
    assert LabelSpace.from_dict(metadata().label_space) == label_space("camvid-11")


def test_what_could_not_be_read_is_not_written():
    big = {"image": np.broadcast_to(np.zeros(1, np.uint8), (65, 1024, 1024))}
    with pytest.raises(ValueError, match="golden image is 65 MiB; expected at most 64"):
        Metadata.of(SSRVLADConfig(), label_space("camvid-11"), {}, big)
