"""pages/reproduce_paper.py on small data: its page, its cache, and the paper's numbers."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts import load, quick, table, write_camvid, write_vpr_bench

PAPER = Path(__file__).parents[2] / "shared" / "paper" / "ssr_vlad.tex"


@pytest.fixture(scope="module")
def run(patch):
    """Runs the script with few frames, small images and no deep networks, in a folder."""
    script = load("reproduce_paper", patch)
    few = {
        "problems": {"CITY_FRAMES": 6, "CITY_SEEDS": (0, 1)},
        "paper_quality": {},
        "paper_cost": {"SIZE": (64, 80), "ROUNDS": 3, "ROUNDS_OF_NETWORKS": 2, "EVERY": 1},
        "paper_noise": {"SHORTER_SIDE": 48, "CITY_FRAMES": 4, "CAMVID_EVERY": 2},
        "paper": {"REPEATS": 2},
    }
    for name, settings in few.items():
        module = load(f"_{name}", patch)
        if hasattr(module, "RIVALS"):
            patch.setattr(module, "RIVALS", quick(module.RIVALS))
        for setting, value in settings.items():
            patch.setattr(module, setting, value)

    def run(folder: Path, *arguments: object) -> str | None:
        output = folder / "docs" / "paper.md"
        own = ("--cache", folder / "cache", "--output", output, "--weights", folder)
        patch.setattr("sys.argv", ["reproduce_paper.py", *map(str, (*own, *arguments))])
        script.main()
        return output.read_text() if output.exists() else None

    return run


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with RobotCar with label maps, SYNTHIA without, and no Extended CMU Seasons."""
    folder = tmp_path_factory.mktemp("home")
    write_vpr_bench(folder / "data" / "CrossSeason_CoHOG_Dataset", 5, labels=True)
    write_vpr_bench(folder / "data" / "Synthia-NightToFall", 5, labels=False)
    write_camvid(folder / "camvid", 8)
    return folder


@pytest.fixture(scope="module")
def page(run, home):
    """What it writes of that."""
    return run(home, "--data", home / "data", "--camvid", home / "camvid")


def test_a_dry_run_lists_what_is_looked_for_and_found(run, home, capsys):
    data = home / "data"
    alone = data / "Synthia-NightToFall"
    for places in (("--data", data), ("--data", alone, "--data", data)):
        assert run(home / "dry", "--dry-run", *places) is None
        told = capsys.readouterr().out.splitlines()
        assert "found    RobotCar: labels -> labels: 5 queries, 5 references" in told
        assert "found    SYNTHIA: images -> images: 5 queries, 5 references" in told
        missing = [line for line in told if line.startswith("missing")]
        assert any("no folder slice7 in --data; visuallocalization.net" in m for m in missing)
        assert any("SYNTHIA, labels: no label maps in" in m for m in missing)
        assert any("Region-VLAD: no weights at" in m for m in missing)


@pytest.mark.slow
def test_ours_stand_beside_the_papers(page):
    robotcar = {cells[0]: cells[1:] for cells in table(page, "### RobotCar")}
    assert robotcar["CoHOG"] == [
        "images -> images",
        *("100.0 [100.0, 100.0]", "9.3", "100.0 [100.0, 100.0]", "50.8"),
        *("1.000 [1.000, 1.000]", "0.620"),
    ]
    assert robotcar["SSR-VLAD, paper, t = 0"][:4] == [
        *("labels -> labels", "100.0 [100.0, 100.0]", "", "100.0 [100.0, 100.0]")
    ]
    assert robotcar["SSR-VLAD, paper"][2::2] == ["38.5", "57.7", "0.855"]
    assert robotcar["Region-VLAD"] == [
        *("images -> images", "weights not here", "7.2"),
        *("weights not here", "87.4", "weights not here", "0.944"),
    ]
    synthia = {cells[0]: cells[1:] for cells in table(page, "### SYNTHIA")}
    assert synthia["SSR-VLAD, paper"][1:3] == ["not here", "96.7"]
    assert synthia["CoHOG"][1:3] == ["100.0 [100.0, 100.0]", "2.3"]


@pytest.mark.slow
def test_what_was_not_run_says_so(page):
    cmu = table(page, "### Extended CMU")
    assert {cells[2] for cells in cmu[1:]} == {"not here"}
    assert {cells[0] for cells in table(page, "### CamVid")} >= {"HOG", "label grid"}
    city = [cells[:3] for cells in table(page, "### Synthetic city")]
    assert ["HOG", "", "no images"] in city
    assert {cells[1] for cells in city if cells[0] == "label grid"} == {"clean", "all together"}
    missing = page[page.index("### What could not be run") : page.index("## Table III")]
    for told in (
        "Extended CMU Seasons, labels and images: no folder slice7 in --data; visuallocaliz",
        "SYNTHIA, labels: no label maps in Synthia-NightToFall/labels, and no --segmenter",
        "Synthetic city, images: it is made of label maps",
        "Region-VLAD: no weights at",
    ):
        assert f"- {told}" in missing


@pytest.mark.slow
def test_all_shifts_are_measured_beside_the_papers(page):
    noise = table(page, "## Table IV")
    assert noise[0][2:] == ["+-25", "+-50", "+-75", "+-100", "+-125", "+-150"]
    assert noise[1][2:] == ["1", "0.989", "0.914", "0.853", "0.797", "0.663"]
    names = [cells[1] for cells in noise[2:]]
    assert names[:3] == names[3:]
    assert [name.split(",")[0] for name in names[:3]] == [
        *("paper", "paper", "paper with `context` keypoints")
    ]
    for cells in noise[2:]:
        for cell in cells[2:]:
            mean, low, high = map(float, re.fullmatch(r"(.+) \[(.+), (.+)\]", cell).groups())
            assert 0 <= low <= mean <= high <= 1


@pytest.mark.slow
def test_costs_are_sorted_and_the_papers_stand_beside_them(page):
    costs = {cells[0]: cells[1:] for cells in table(page, "## Table III")}
    assert costs["CoHOG"][3:] == ["240.89/105.73/92.29", "", "2.5/1.4/0.9"]
    assert "Region-VLAD (random weights)" in costs
    for name, (extraction, encoding, match, *_) in costs.items():
        if name != "method" and extraction:
            for cell in (extraction, encoding, match) if encoding else (extraction, match):
                largest, mean, smallest = map(float, cell.split("/"))
                assert 0 <= smallest <= mean <= largest
            assert bool(encoding) == name.startswith(("SSR-VLAD", "Region-VLAD"))


@pytest.mark.slow
def test_the_figure_is_a_picture(page, home):
    figure = Image.open(home / "docs" / "figures" / "paper_pr_curves.png")
    assert figure.format == "PNG"
    assert min(figure.size) > 500
    assert len(np.unique(np.asarray(figure.convert("L")))) > 50


@pytest.mark.slow
def test_an_interrupted_run_goes_on_where_it_was(run, monkeypatch, capsys, tmp_path):
    trials = load("_trials", monkeypatch)
    real, done = trials._run, []

    def work(method, problem):
        if len(done) == 5:
            raise KeyboardInterrupt
        settings = (getattr(method, name, None) for name in ("config", "temporal"))
        done.append((method.name, *settings, problem.name))
        return real(method, problem)

    monkeypatch.setattr(trials, "_run", work)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, "--only", "table1")
    done.append("so that it is not interrupted again")
    run(tmp_path, "--only", "table1")
    assert len(done) == len(set(done)) == 12 + 1
    monkeypatch.setattr(trials, "_run", None)
    capsys.readouterr()
    run(tmp_path, "--only", "table1")
    printed = capsys.readouterr().out
    assert len(table(printed, "### Synthetic city")) == 1 + 12 + 4
    assert "- CamVid, odd against even, labels and images: no --camvid; mi.eng.cam" in printed


def test_another_source_of_the_package_takes_no_old_results(monkeypatch, tmp_path):
    trials = load("_trials", monkeypatch)
    kept = trials.Cache(tmp_path)
    assert kept.get(("x", 1), lambda: [1.5]) == kept.get(("x", 1), lambda: [2.5]) == [1.5]
    assert kept.get(("x", 2), lambda: [2.5]) == [2.5]
    monkeypatch.setattr(trials, "_source", lambda: "changed")
    assert kept.get(("x", 1), lambda: [3.5]) == [3.5]


@pytest.mark.slow
def test_one_part_alone_writes_no_page(run, capsys, tmp_path):
    assert run(tmp_path, "--only", "table4") is None
    printed = capsys.readouterr().out
    assert "## Table IV" in printed
    assert "## Table I:" not in printed
    assert not (tmp_path / "docs").exists()


@pytest.mark.skipif(not PAPER.is_file(), reason="the paper of ../shared is not on this machine")
def test_the_papers_numbers_are_those_of_its_source(monkeypatch):
    paper = load("_paper", monkeypatch)
    text = PAPER.read_text()
    first, costs = text[text.index("label{table1}") :].split("label{table3}")
    first = re.sub(r"\\textbf\{([^}]*)\}", r"\1", first)
    lines = re.findall(r"\{(?:Recall@100\\%Precision|RecallRate@1|AUC)\}(.*?)\\\\", first, re.S)
    cells = [re.findall(r"(?:\{c\|\}\{|&\s*)([\d.]+|-)(?=\}|\s*$)", line) for line in lines]
    printed = [list(zip(*cells[n : n + 3], strict=True)) for n in (0, 3, 6)]
    assert printed == [list(methods.values()) for methods in paper.TABLE_I.values()]
    cells = re.findall(r"\d[\d.]*/\d[\d.]*/\d[\d.]*", costs[: costs.index("section{Results}")])
    ours = zip(*paper.TABLE_III.values(), strict=True)
    assert cells == [cell for step in ours for cell in step if cell]
    noise = text[text.index("20 times") :]
    line = noise[noise.index("\n") : noise.index("\\hline")]
    assert re.findall(r"\d[\d.]*", line) == list(paper.TABLE_IV.values())
