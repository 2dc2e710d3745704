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


def test_metadata_survive_a_round_trip():
    """Settings and label space, and the golden arrays bit by bit."""
    interface = {"opset": 18, "inputs": {}, "outputs": {}}
    metadata = Metadata.of(SSRVLADConfig(), label_space("camvid-11"), interface, ARRAYS)
    properties = metadata.to_properties()
    assert all(isinstance(value, str) for value in properties.values())
    back = Metadata.from_properties({"other": "tool", **properties})
    assert back == metadata
    assert properties[PREFIX + "version"] == ssrvlad_torch.__version__
    assert properties[PREFIX + "fingerprint"] == SSRVLADConfig().fingerprint
    assert LabelSpace.from_dict(back.label_space) == label_space("camvid-11")
    arrays = back.golden_arrays()
    assert list(arrays) == sorted(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)


def test_a_golden_pair_too_large_to_read_is_refused():
    big = {"image": np.broadcast_to(np.zeros(1, np.uint8), (65, 1024, 1024))}
    with pytest.raises(ValueError, match="golden image is 65 MiB; expected at most 64"):
        Metadata.of(SSRVLADConfig(), label_space("camvid-11"), {}, big)
