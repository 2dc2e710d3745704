import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.confidence import ALONE, ALONE_BY_FEATURES, Confidence, accept
from ssrvlad_torch.recognition.decoys import lead_over_decoys
from ssrvlad_torch.recognition.recognise import AS_PAPER, NO_SEQUENCE, SSR_VLAD, Steps, recognise
from ssrvlad_torch.recognition.signs import SignQueries, SignRows, mirrored
from ssrvlad_torch.recognition.sweep import COLUMNS


def two_traverses(
    rows: int, noise: float, common: float = 2.0, near: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """Each frame looks like the ``near - 1`` before it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(rows + near - 1, 64, generator=generator).unfold(0, near, 1).sum(-1)
    places /= near**0.5
    return tuple(
        F.normalize(
            places
            + common * torch.randn(64, generator=generator)
            + noise * torch.randn(rows, 64, generator=generator),
            dim=1,
        )
        for _ in range(2)
    )


def right(found, rows: int) -> float:
    return (found.matches.indices[:, 0] == torch.arange(rows)).float().mean().item()


def test_each_step_finds_more():
    queries, references = two_traverses(80, 1.6)
    names = ["q"] * 80, ["r"] * 80
    rates = [
        right(recognise(queries, references, *names, steps), 80)
        for steps in (AS_PAPER, Steps(follow=None), Steps(follow="online"), Steps())
    ]
    assert rates == sorted(rates) and rates[0] < 0.9 * rates[-1] and rates[-1] > 0.97


def test_a_few_queries_have_no_mean_of_their_own():
    """Anchors of one picture have nearly all in common, which is where it was taken."""
    queries, references = two_traverses(80, 0.8, common=0.0)
    swept = F.normalize(queries[:, None] + 0.1 * torch.randn(80, len(COLUMNS), 64), dim=2)
    alone = [recognise(query[None], references, ["q"], ["r"] * 80) for query in swept]
    found = torch.stack([each.matches.indices[0, 0] for each in alone])
    assert (found == torch.arange(80)).float().mean() > 0.9
    assert alone[0].used["standardise"] == {"q": False}
    whole = recognise(swept, references, ["q"] * 80, ["r"] * 80)
    assert whole.used["standardise"] == {"q": True}


def test_queries_that_are_no_sequence_are_judged_one_by_one():
    queries, references = two_traverses(80, 0.8)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(0))
    found = recognise(queries[order], references, ["q"] * 80, ["r"] * 80)
    alone = recognise(queries[order], references, ["q"] * 80, ["r"] * 80, Steps(follow=None))
    assert found.used["follow"] == {"q": NO_SEQUENCE}
    assert torch.equal(found.matches.indices, alone.matches.indices)
    kept = recognise(queries, references, ["q"] * 80, ["r"] * 80)
    assert kept.used["follow"] == {"q": "offline"}


def test_a_map_in_small_folders_is_searched_as_one_that_is_whole():
    """Folders of two frames would have v and -v after their own means are subtracted."""
    queries, references = two_traverses(80, 0.8)
    order, cut = torch.arange(80), [f"{row // 2:02d}" for row in range(80)]
    for names in (["r"] * 80, cut):
        found = recognise(queries, references, ["q"] * 80, names, Steps(follow=None))
        assert (found.matches.indices[:, 0] == order).float().mean() > 0.95


def test_folders_too_short_to_be_followed_spoil_no_answer():
    queries, references = two_traverses(80, 0.8, common=0.0, near=8)
    names = ["q"] * 80, [f"{row // 5:02d}" for row in range(80)]
    alone = recognise(queries, references, *names, Steps(follow=None))
    for mode in ("online", "offline"):
        found = recognise(queries, references, *names, Steps(follow=mode))
        assert found.used["follow"] == {"q": NO_SEQUENCE}
        assert torch.equal(found.matches.indices, alone.matches.indices)
        assert right(found, 80) > 0.6


def test_two_streams_in_turn_are_followed_each_by_itself():
    queries, references = two_traverses(80, 1.6)
    order = torch.arange(80).view(2, 40).T.flatten()
    found = recognise(queries[order], references, ["q"] * 80, ["r"] * 80)
    assert found.used["follow"] == {"q": "offline, 2 streams in turn"}
    assert (found.matches.indices[:, 0] == order).float().mean() > 0.97


def test_queries_in_reverse_order_are_followed_backwards():
    queries, references = two_traverses(80, 1.6)
    found = recognise(queries.flip(0), references, ["q"] * 80, ["r"] * 80, Steps(follow="online"))
    assert found.used["follow"] == {"q": "online, backwards"}
    assert (found.matches.indices[:, 0] == torch.arange(79, -1, -1)).float().mean() > 0.9


def test_a_single_query_is_never_followed():
    queries, references = two_traverses(80, 0.8)
    for query in queries:
        found = recognise(query[None], references, ["q"], ["r"] * 80)
        assert found.used["follow"] == {"q": NO_SEQUENCE}
        assert found.matches.scores[0, 0] == pytest.approx(float((references @ query).max()))


def test_the_paper_decides_by_the_cosine():
    queries, references = two_traverses(30, 1.0)
    found = recognise(queries, references, ["q"] * 30, ["r"] * 30, AS_PAPER)
    expected = (queries @ references.T).topk(5)
    assert torch.equal(found.matches.indices, expected.indices)
    torch.testing.assert_close(found.matches.scores, expected.values)


def test_a_sweep_is_used_or_left():
    queries, references = two_traverses(40, 0.5)
    swept = torch.randn(40, len(COLUMNS), 64, generator=torch.Generator().manual_seed(1))
    swept = F.normalize(swept, dim=2)
    swept[:, -1] = queries
    names = ["q"] * 40, ["r"] * 40
    wide = recognise(swept, references, *names, Steps(follow=None))
    narrow = recognise(swept, references, *names, Steps(follow=None, sweep=False))
    assert wide.used["sweep"] == {"q": max(COLUMNS)} and right(wide, 40) > 0.6
    assert narrow.used["sweep"] == {"q": 0} and right(narrow, 40) < 0.2


def test_what_is_barred_is_no_candidate():
    queries, references = two_traverses(30, 0.3)
    barred = torch.eye(30, dtype=torch.bool)
    for steps in (Steps(), AS_PAPER):
        found = recognise(queries, references, ["q"] * 30, ["r"] * 30, steps, 3, barred)
        assert right(found, 30) == 0


def exchange(vectors: torch.Tensor) -> torch.Tensor:
    """A mirror: it changes the sign of every second number."""
    return vectors * torch.tensor([1.0, -1]).repeat(vectors.shape[-1] // 2)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("steps", [Steps(follow=None), AS_PAPER])
def test_decoys_tell_right_answers_from_wrong_ones(steps, extra):
    queries, references = two_traverses(120, 1.3 if steps.standardise else 0.8)
    foreign = two_traverses(240, 1.3)[0][120:]
    pairs = {"own": (queries, references)} if extra else None
    mirrors = {SSR_VLAD: exchange, "own": exchange}
    names = ["q"] * 120, ["r"] * 120
    found = recognise(queries, references, *names, steps, 1, None, pairs, mirrors)
    wrong = found.matches.indices[:, 0] != torch.arange(120)
    sure = found.confidence
    assert sure[wrong].mean() < 0.7 * sure[~wrong].mean() and wrong.float().mean() > 0.05
    kept = accept(found.sure, 0.1)
    assert kept.accepted > 30
    assert wrong[sure >= kept.confidence].float().mean() <= kept.high
    pairs = {"own": (foreign, references)} if extra else None
    lost = recognise(foreign, references, *names, steps, 1, None, pairs, mirrors)
    assert accept(lost.sure, 0.1).accepted == 0
    assert 40 <= (lost.sure.decoy > 0).sum() <= 80


def test_a_few_pictures_with_much_in_common_have_fair_decoys():
    """Mirroring what all frames share would leave decoys that are never near."""
    queries, references = two_traverses(240, 3.0, common=8.0)
    alone = [
        recognise(
            query[None], references[:120], ["q"], ["r"] * 120, mirrors={SSR_VLAD: exchange}
        ).sure
        for query in queries[120:]
    ]
    assert 40 <= sum(bool(each.decoy > 0) for each in alone) <= 80


def test_without_decoys_confidence_is_the_prior():
    queries, references = two_traverses(80, 0.8)
    names = ["q"] * 80, ["r"] * 80
    found = recognise(queries, references, *names, Steps(follow=None))
    assert found.sure.decoy.isnan().all() and 0 < found.confidence.min() < 0.7
    alone = recognise(queries[:1], references, ["q"], ["r"] * 80, Steps(False, follow=None))
    whole = recognise(queries, references, *names, Steps(False, follow=None))
    torch.testing.assert_close(alone.confidence, whole.confidence[:1])


def test_a_lead_says_more_where_features_are_compared():
    signs = torch.randint(256, (40, 16, 16, 8), generator=torch.Generator().manual_seed(0)).byte()
    query = signs[7:8].clone()
    query[:, 1:] = signs[20, 1:] ^ signs[30, 1:]
    scores, decoys = (
        SignQueries(each, SignRows(signs)).scores()[0] for each in (query, mirrored(query))
    )
    lead = torch.tensor([lead_over_decoys(scores, decoys).value])
    found = recognise(query, signs, ["q"], ["r"] * 40, Steps(follow=None)).confidence
    torch.testing.assert_close(found, Confidence.of_leads(lead, ALONE_BY_FEATURES, 1.0).right)
    assert found > Confidence.of_leads(lead, ALONE, 1.0).right + 0.01


def test_few_references_give_no_confidence():
    queries, references = two_traverses(29, 0.3)
    found = recognise(queries, references, ["q"] * 29, ["r"] * 29, Steps(follow=None))
    assert right(found, 29) > 0.9 and not found.confidence.any()


def test_refuses():
    with pytest.raises(ValueError, match="each of 4 queries, got 1"):
        recognise(torch.eye(4), torch.eye(4), ["a"], ["b"] * 4)
    with pytest.raises(ValueError, match="a sequence for each of 4 references, got 3"):
        recognise(torch.eye(4), torch.eye(4), ["a"] * 4, ["b"] * 3, AS_PAPER)
    with pytest.raises(ValueError, match=r"excluded: expected \(4, 4\) bool, got \(1, 4\)"):
        recognise(torch.eye(4), torch.eye(4), ["a"] * 4, ["b"] * 4, excluded=torch.ones(1, 4) > 0)
    with pytest.raises(ValueError, match="expected mirrors of ssr-vlad, got hog"):
        recognise(torch.eye(4), torch.eye(4), ["a"] * 4, ["b"] * 4, mirrors={"hog": exchange})


def test_no_queries_give_no_candidates():
    found = recognise(torch.zeros(0, 4), torch.eye(4), [], ["b"] * 4, top=3)
    assert found.matches.indices.shape == (0, 3) and found.confidence.shape == (0,)
