"""The sweep: scores of the best anchor, and how wide it is."""

import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.matching import Rows
from ssrvlad_torch.recognition.standardise import standardise
from ssrvlad_torch.recognition.sweep import narrowed, score


def test_a_reference_scores_its_best_anchor():
    swept = F.normalize(torch.randn(5, 3, 8), dim=2)
    references = F.normalize(torch.randn(7, 8), dim=1)
    swept[4], references[6] = 0, 0
    expected = torch.einsum("qsd,rd->qsr", swept, references).amax(1)
    expected[4], expected[:, 6] = -torch.inf, -torch.inf
    torch.testing.assert_close(score(swept, references), expected)
    torch.testing.assert_close(
        score(swept[:, 1], references)[:4, :6], (swept[:4, 1] @ references[:6].T)
    )


@pytest.mark.parametrize(("true_anchor", "width"), [(2, 0), (4, 8)])
def test_the_sweep_is_as_wide_as_the_view_is_shifted(true_anchor, width):
    generator = torch.Generator().manual_seed(0)
    places = F.normalize(torch.randn(40, 64, generator=generator), dim=1)
    swept = torch.randn(40, 5, 64, generator=generator)
    swept[:, true_anchor] = places * 6 + 0.3 * torch.randn(40, 64, generator=generator)
    kept, reach = narrowed(
        F.normalize(swept, dim=2), Rows.of(standardise(places)), (-8, -4, 0, 4, 8)
    )
    assert reach == width and kept.shape[1] == 1 + width // 2
    assert (score(kept, standardise(places)).argmax(1) == torch.arange(40)).float().mean() > 0.9


def test_refuses():
    with pytest.raises(ValueError, match=r"got \(3, 2, 4\) and \(5, 3\)"):
        score(torch.zeros(3, 2, 4), torch.zeros(5, 3))
    with pytest.raises(ValueError, match="one of which is 0"):
        narrowed(torch.zeros(3, 2, 4), Rows.of(torch.ones(5, 4)), (-4, 4))
