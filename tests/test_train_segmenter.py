"""pages/train_segmenter.py on small drives: its page, resuming, and the way of the network."""

import csv
import re

import numpy as np
import pytest
import torch
from torch import nn

from scripts import load, table, write_camvid
from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.segmentation.segmenter import Segmenter

SPACE = "camvid-11"
SIZE = 48, 64


@pytest.fixture(scope="module")
def camvid(tmp_path_factory):
    return write_camvid(tmp_path_factory.mktemp("camvid"), 12, ("0001TP", "0016E5"))


@pytest.fixture(scope="module")
def made(patch, camvid, tmp_path_factory):
    """The folder in which the whole script has run, a few steps of everything."""
    home = tmp_path_factory.mktemp("made")
    script, twin = load("train_segmenter", patch), load("_train_twin", patch)
    patch.setattr(twin, "FRAMES", 2)
    patch.setattr(twin, "TEMPERATURES", (1.0,))
    patch.setattr(twin, "cost", lambda: iter(["## Cost of SoftSSRVLAD\n"]))
    given = {"--camvid": camvid, "--work": home / "work", "--output": home / "docs" / "page.md"}
    told = [str(part) for pair in given.items() for part in pair]
    told += ["--onnx", str(home / "net.onnx"), "--size", "48", "64", "--seeds", "4"]
    patch.setattr("sys.argv", ["train", *told, "--steps", "30", "--fine-tune-steps", "4"])
    script.main()
    return home


@pytest.fixture
def loop(patch):
    return load("_train_loop", patch)


@pytest.fixture
def problem(patch, camvid):
    """Ten frames to train on, and a head."""
    script = load("train_segmenter", patch)
    drive = script.read_drive(camvid, "0016E5", SIZE)
    return script.split(drive, SSRVLAD.from_preset("default", surrogate=True, labels_as=SPACE))


def network(patch, seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return load("_train_network", patch).CompactNetwork(11, widths=(4, 6, 8, 8))


# ---- the page


@pytest.mark.slow
def test_the_page_has_every_network_with_intervals(made):
    page = (made / "docs" / "page.md").read_text()
    rows = table(page, "## Before and after")
    figures = ["mIoU", "RecallRate@1, odd-even", "RecallRate@1, any frame", "cosine to own labels"]
    assert rows[0][2:] == figures
    assert [row[:2] for row in rows[1:]] == [
        *(["4", name] for name in ("before", "cross-entropy alone", "with the place loss")),
        *(["mean", name] for name in ("before", "cross-entropy alone", "with the place loss")),
        ["-", "hand-made labels"],
    ]
    for row in rows[1:]:
        for cell in row[2:]:
            value, low, high = map(float, re.fullmatch(r"(.+) \[(.+), (.+)\]", cell).groups())
            assert 0 <= low <= value <= high <= 1.001
    assert rows[-1][2] == rows[-1][4] == "1.000 [1.000, 1.000]"
    assert page.count("Does the place loss raise RecallRate@1") == 1


@pytest.mark.slow
def test_the_page_has_the_twin_by_category(made):
    rows = table((made / "docs" / "page.md").read_text(), "## Accuracy of SoftSSRVLAD")
    assert rows[0][3:6] == ["descriptor", "ground", "sidewalk"]
    assert len(rows) == 1 + 3 * 2
    for row in rows[1:]:
        assert float(row[3]) > (0.98 if row[1] == "default" else 0.85), row


@pytest.mark.slow
def test_logs_are_tables(made):
    with (made / "work" / "seed4" / "place" / "log.csv").open(newline="") as file:
        (last,) = csv.DictReader(file)
    assert last["step"] == "4"
    assert float(last["cross_entropy"]) > 0
    assert float(last["place_loss"]) > 0
    assert 0 <= float(last["validation_miou"]) <= 1


@pytest.mark.slow
def test_a_second_run_trains_nothing_and_says_the_same(made, patch):
    before = {file: file.read_bytes() for file in made.rglob("*") if file.suffix in (".md", ".pt")}
    with pytest.MonkeyPatch.context() as no_training:
        no_training.setattr(load("_train_loop", patch), "_step", None)
        load("train_segmenter", patch).main()
    assert before == {file: file.read_bytes() for file in before}


@pytest.mark.parametrize(
    ("gain", "lost", "words"),
    [
        ((0.05, (0.01, 0.09)), 0.002, "**Yes**"),
        ((0.05, (-0.01, 0.09)), 0.002, "contains zero"),
        ((0.05, (0.01, 0.09)), 0.02, "more than one point"),
        ((-0.05, (-0.09, -0.01)), 0.0, "Recall falls"),
    ],
)
def test_the_verdict_follows_from_the_figures(patch, gain, lost, words):
    report = load("_train_report", patch)
    found = {report.RECALL: gain, "mIoU": (-lost, (-lost, -lost))}
    assert words in report.verdict(found)


# ---- the loop


class KilledError(Exception):
    """Stands for a process that is killed."""


def test_a_run_that_was_killed_goes_on_as_if_it_had_not_been(patch, loop, problem, tmp_path):
    phase = loop.Phase("phase", steps=4, rate=1e-2, every=2, place=1.0)
    whole, broken = network(patch), network(patch)
    loop.train(whole, phase, problem, tmp_path / "whole", seed=3)

    step = loop._step

    def until_killed(state, *rest):
        if state.step == 3:
            raise KilledError
        return step(state, *rest)

    with pytest.MonkeyPatch.context() as kill, pytest.raises(KilledError):
        kill.setattr(loop, "_step", until_killed)
        loop.train(broken, phase, problem, tmp_path / "broken", seed=3)
    resumed = network(patch, seed=9)
    loop.train(resumed, phase, problem, tmp_path / "broken", seed=3)
    for name, value in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name
    logs = [(tmp_path / run / "log.csv").read_text() for run in ("whole", "broken")]
    assert logs[0] == logs[1]
    assert len(logs[0].splitlines()) == 1 + 2


def test_a_checkpoint_of_another_run_is_refused(patch, loop, problem, tmp_path):
    phase = loop.Phase("phase", steps=1, rate=1e-2)
    loop.train(network(patch), phase, problem, tmp_path, seed=3)
    with pytest.raises(ValueError, match=r"checkpoint\.pt is of another run"):
        loop.train(network(patch), phase, problem, tmp_path, seed=4)


def test_training_stops_early_and_takes_the_best(patch, loop, problem, tmp_path):
    scores = iter([0.1, 0.5, 0.4, 0.3, 0.9])
    patched = pytest.MonkeyPatch()
    patched.setattr(loop, "mean_iou", lambda _: next(scores))
    phase = loop.Phase("phase", steps=9, rate=1e-2, every=1, patience=2)
    trained = network(patch)
    loop.train(trained, phase, problem, tmp_path / "early", seed=3)
    patched.undo()
    best = network(patch)
    state = torch.load(tmp_path / "early" / "checkpoint.pt", weights_only=True)
    assert state["step"] == 4
    assert [row["validation_miou"] for row in state["log"]] == [0.1, 0.5, 0.4, 0.3]
    best.load_state_dict(state["best_weights"])
    for name, value in best.state_dict().items():
        assert torch.equal(trained.state_dict()[name], value)


def test_the_place_loss_reaches_the_weights(patch, loop, problem):
    trained = network(patch)
    batch = loop.draw(problem.training, 4, 0, zoomed=False)
    loss = loop._loss(loop.Phase("place", 1, 1e-3, place=1.0), problem)
    scores = trained(batch.images)
    entropy = nn.functional.cross_entropy(scores, batch.targets, ignore_index=11)
    (loss(batch, scores)[0] - entropy).backward()
    assert all(weight.grad.any() for weight in trained.scores.parameters())


def test_the_bank_is_mirrored_where_the_image_is(loop, problem):
    bank = loop._bank(problem)
    labels = problem.training.labels
    assert torch.equal(bank[1, 0], problem.head(labels[:1].flip(-1))[0])
    assert torch.equal(bank[0], loop.describe(problem.head, labels))


# ---- data, network, measures


def test_a_label_map_moves_with_its_image(patch, problem):
    """What is seen narrower is so in both, and what comes from outside is void."""
    data = load("_train_data", patch)
    ramp = torch.arange(12).repeat_interleave(5)[None, None].expand(8, 1, 40, 60).float()
    images, ids = data.augmentation(zoomed=True)(ramp.expand(-1, 3, -1, -1) / 11, ramp - 11)
    assert not torch.equal(ids, ramp - 11)
    inside = ids < 0
    assert 0.3 < inside.float().mean() < 1
    order = [images[number].mean(0)[inside[number, 0]] for number in range(8)]
    for number, brightness in enumerate(order):
        of_pixels = torch.stack([brightness, ids[number, 0][inside[number, 0]]])
        assert torch.corrcoef(of_pixels)[0, 1] > 0.9


def test_intersection_over_union_by_hand(loop):
    labels = torch.tensor([[[0, 0, 1], [1, 11, 11]]])
    predicted = torch.tensor([[[0, 1, 1], [2, 0, 1]]])
    counts = loop.confusion(predicted, labels)
    assert int(counts.sum()) == 4
    assert loop.mean_iou(counts.sum(0)) == pytest.approx((1 / 2 + 1 / 3) / 2)


def test_estimates_of_outcomes(patch, loop):
    measure = load("_train_measure", patch)
    labels = torch.randint(0, 3, (40, 4, 5), generator=torch.Generator().manual_seed(0))
    right = torch.arange(40) % 4 > 0
    good = measure.Outcome(loop.confusion(labels, labels), right, right | True, right)
    bad = measure.Outcome(loop.confusion((labels + 1) % 3, labels), ~right, right, ~right)
    found, than = measure.estimates([good]), measure.estimates([good, good], [bad, good])
    assert found["mIoU"] == (1.0, (1.0, 1.0))
    assert found["RecallRate@1, odd-even"][0] == 0.75
    assert 0.5 < found["RecallRate@1, odd-even"][1][0] < 0.75
    assert than["mIoU"][0] == 0.5
    assert than["RecallRate@1, odd-even"][0] == pytest.approx(0.25)


# ---- the way of the trained network


@pytest.mark.slow
def test_the_trained_network_from_image_to_descriptor(made, camvid, ssrvlad, tmp_path):
    """`fuse` makes one file of it, and `encode --segmenter` a database; both agree."""
    onnxruntime = pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")
    assert ssrvlad("export", "-o", tmp_path / "head.onnx", "--labels-as", SPACE)[0] == 0
    place = tmp_path / "place.onnx"
    assert ssrvlad("fuse", made / "net.onnx", "-o", place, "--labels-as", SPACE)[0] == 0
    images, town = camvid / "0001TP" / "images", tmp_path / "town.ssrdb"
    network = ["--segmenter", made / "net.onnx", "--segmenter-cache", tmp_path / "cache"]
    assert ssrvlad("encode", images, "-o", town, "--labels-as", SPACE, *network)[0] == 0

    segmenter = Segmenter.load(made / "net.onnx", SPACE)
    pictures = [read_image(FrameFile("a", p.stem, p)) for p in sorted(images.glob("*.png"))]
    labels = torch.from_numpy(np.stack(segmenter(pictures)))
    assert len(labels.unique()) > 2
    described = SSRVLAD.from_preset("default", labels_as=SPACE)(labels)
    references = Database.open(town).load()
    torch.testing.assert_close(references.descriptors, described, rtol=0, atol=1e-6)

    whole, head = (
        onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        for file in (place, tmp_path / "head.onnx")
    )
    (descriptor,) = whole.run(["descriptor"], {"image": np.stack(pictures)})
    np.testing.assert_allclose(descriptor, described, rtol=0, atol=1e-4)
    (alone,) = head.run(["descriptor"], {"labels": labels.numpy()})
    np.testing.assert_allclose(alone, described, rtol=0, atol=1e-6)
