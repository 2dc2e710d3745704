"""The sweep: scores of the best anchor, and how wide it is."""

import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.recognise import Steps, recognise, references_of
from ssrvlad_torch.recognition.sweep import COLUMNS, score


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


@pytest.mark.parametrize(("true_anchor", "width"), [(6, 0), (4, 8)])
def test_the_sweep_is_as_wide_as_the_view_is_shifted(true_anchor, width):
    generator = torch.Generator().manual_seed(0)
    places = F.normalize(torch.randn(40, 64, generator=generator), dim=1)
    swept = torch.randn(40, len(COLUMNS), 64, generator=generator)
    swept[:, true_anchor] = places * 6 + 0.3 * torch.randn(40, 64, generator=generator)
    queries, town = {"x": F.normalize(swept, dim=2)}, references_of({"x": places}, ["a"] * 40)
    found = recognise(queries, ["q"] * 40, town, Steps(follow=None))
    assert found.used["sweep"] == {"q": width}
    assert (found.matches.indices[:, 0] == torch.arange(40)).float().mean() > 0.9
