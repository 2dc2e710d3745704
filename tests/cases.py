"""Label maps and settings on which every path must give what the reference gives."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from drawings import CAR, MASKS, ROAD, TREE, VOID, mask
from PIL import Image

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, reference

REAL = Path(__file__).parents[2] / "shared" / "data"
CAMVID = REAL / "camvid"

needs_camvid = pytest.mark.skipif(
    not CAMVID.is_dir(), reason="the CamVid labels of ../shared/data are not on this machine"
)
needs_real = pytest.mark.skipif(
    not (REAL / "networks").is_dir(), reason="the networks of ../shared/data are not here"
)


def degenerate() -> dict[str, npt.NDArray[np.uint8]]:
    """Extreme label maps."""
    checkerboard = np.indices((17, 23)).sum(0) % 2
    return {
        "one pixel": np.full((1, 1), ROAD, np.uint8),
        "one row": np.repeat(np.array([[ROAD, TREE, VOID]], np.uint8), 5, axis=1),
        "one column": np.repeat(np.array([[ROAD], [TREE]], np.uint8), 9, axis=0),
        "all void": np.full((12, 9), VOID, np.uint8),
        "all dynamic": np.full((9, 12), CAR, np.uint8),
        "all one class": np.full((31, 44), ROAD, np.uint8),
        "checkerboard": np.where(checkerboard, ROAD, TREE).astype(np.uint8),
        "checkerboard and void": np.where(checkerboard, ROAD, VOID).astype(np.uint8),
    }


def hand_drawn() -> dict[str, npt.NDArray[np.uint8]]:
    """Each drawing as the road layer, on a ground of trees."""
    return {
        name: np.where(mask(drawing), ROAD, TREE).astype(np.uint8)
        for name, drawing in MASKS.items()
    }


def camvid_labels(every: int) -> list[npt.NDArray[np.uint8]]:
    """Hand-made labels of both CamVid sequences, one frame in ``every``."""
    files = sorted(CAMVID.glob("*/labels/*.png"))
    return [np.asarray(Image.open(file)) for file in files[::every]]


def assert_equals_reference(labels: npt.NDArray[np.integer], config: SSRVLADConfig) -> None:
    """The module and the reference agree on one label map at every step."""
    view = SSRVLAD(config).explain(torch.tensor(labels)[None])
    layers = reference.layers_of(labels, config)
    traces = [reference.trace(layer, config) for layer in layers]
    for k, trace in enumerate(traces):
        for name, expected, got in (
            ("layer", trace.layer, view.layers),
            ("clean layer", trace.clean, view.clean_layers),
            ("skeleton", trace.skeleton, view.skeleton),
            ("end points", trace.end_points, view.end_points),
            ("intersections", trace.intersections, view.intersections),
        ):
            np.testing.assert_array_equal(got[0, k].numpy(), expected, f"{name} of layer {k}")
        assert tuple(view.centres[0, k].tolist()) == (trace.centre or (-1, -1)), f"centre {k}"
    expected = (
        reference.harmonics(layers, config)
        if config.aggregation == "harmonics"
        else reference.residuals(traces, config)
    )
    for name, histogram in expected.histograms.items():
        got = getattr(view.histograms, name)[0].numpy()
        if name == "bins":  # roots: of a share near 0, a root shows the rounding of its table
            np.testing.assert_allclose(got**2, histogram**2, rtol=1e-12, atol=1e-15, err_msg=name)
        else:
            np.testing.assert_array_equal(got, histogram, name)
    np.testing.assert_allclose(view.descriptor[0].numpy(), expected.descriptor, rtol=0, atol=1e-6)
