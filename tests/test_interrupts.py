"""An interrupt between any two lines leaves a stream or a map whole: what was begun is done, or can
be done again, and all later answers are those of an undisturbed run."""

import shutil
from functools import partial

import numpy as np
import pytest
import torch
from helpers import Lines, write_maps
from loop_streams import views

from ssrvlad_torch import SSRVLAD, Database, LoopDetector, Map
from ssrvlad_torch.encoding.results import EncodeOptions
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.search.index import build

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
CONFIG = LoopConfig(exclude=5, sweep=False)
STREAM = ["loops", "native/loops.py", "native/addresses.py"]
STORE = ["loops", "database/database.py", "database/engine.py"]
ADD, INDEX = ["map.py", "database", "encoding/plan.py"], ["search"]
VECTORS = views([*range(40), *range(10, 40)])


steps = pytest.mark.parametrize("step", [12, pytest.param(1, marks=pytest.mark.slow)])
"""At every twelfth line and the last ten; the slow tests interrupt at every one."""


def numbers(lines, step):
    return sorted({*range(1, lines.count + 1, step), *range(lines.count - 9, lines.count + 1)})


def show(detector, row):
    """Shows a frame, unless the detector has it already."""
    name = f"{'first' if row < 40 else 'again'}/{row}"
    if name not in detector:
        return detector.update(VECTORS[row], name, row / 2, (row, 0.0))
    return None


def detector_of(rows):
    detector = LoopDetector(CONFIG, HEAD)
    for row in range(rows):
        show(detector, row)
    return detector


@steps
def test_after_an_interrupted_update_the_stream_goes_on_as_if_there_was_none(step):
    """The frame is shown again if the detector does not have it."""
    undisturbed, detector = detector_of(50), detector_of(50)
    expected = [show(undisturbed, row) for row in range(50, 60)]
    lines, sizes = Lines(STREAM), set()
    lines.run(lambda: show(detector, 50))
    for at in numbers(lines, step):
        detector = detector_of(50)
        assert Lines(STREAM, at).run(partial(show, detector, 50))
        sizes.add(len(detector))
        assert show(detector, 50) in (None, expected[0])
        assert [show(detector, row) for row in range(51, 60)] == expected[1:]
        assert detector.frames == undisturbed.frames
        np.testing.assert_array_equal(detector.poses, undisturbed.poses)
    assert sizes == {50, 51}
    assert any(result.accepted for result in expected[1:])


@steps
def test_after_an_interrupted_save_the_next_one_goes_on(tmp_path, step):
    """Whether its commit was made or not; the stream has gone on meanwhile."""
    lines, detector = Lines(STORE), detector_of(2)
    database = Database.create(tmp_path / "first", HEAD.config)
    lines.run(lambda: detector.save(database))
    fresh = set()
    for turn, at in enumerate(numbers(lines, step), 1):
        if turn % 20 == 1:  # a database of few versions is fast
            database, detector = Database.create(tmp_path / str(at), HEAD.config), detector_of(0)
        before = len(detector)
        show(detector, before)
        Lines(STORE, at).run(partial(detector.save, database))
        fresh.add(len(Database.open(database.path)) - before)
        show(detector, before + 1)
        detector.save(database)
        if turn % 20 == 0 or at == lines.count:
            stored = LoopDetector.load(Database.open(database.path), CONFIG, HEAD)
            assert stored.frames == detector.frames
            vectors = Database.open(database.path).load()
            for frame, vector in zip(vectors.frames, vectors.descriptors.numpy(), strict=True):
                np.testing.assert_array_equal(vector, VECTORS[int(frame.rpartition("/")[2])])
    assert fresh == {0, 1}


def test_frames_of_another_stream_are_not_taken_for_saved_ones(tmp_path):
    """Though they have the same names."""
    database = Database.create(tmp_path / "db", HEAD.config)
    detector_of(3).save(database)
    with pytest.raises(ValueError, match="expected the database of this stream, with no frame"):
        detector_of(3).save(database)


def add(town, maps):
    """In this thread alone, which is the one that is interrupted."""
    town.add(maps, EncodeOptions(workers=1))


def places(answers):
    return [
        (answer.query, answer.confidence, [(each.frame, each.score) for each in answer.candidates])
        for answer in answers
    ]


@pytest.mark.parametrize(
    ("files", "stored"), [(ADD, 0), pytest.param(INDEX, 2, marks=pytest.mark.slow)]
)
def test_after_an_interrupted_add_the_map_goes_on(tmp_path, files, stored):
    """At every twelfth line of a new one, or of one of two frames with an index: it has what is
    stored, and the next `add` adds what is missing."""
    maps = write_maps(tmp_path / "monday", range(3))
    right = Map.open(tmp_path / "right", labels_as="camvid-11")
    add(right, maps)
    expected, answers = right.database.load(), places(right.query(maps))

    if stored:
        base = Map.open(tmp_path / "base", labels_as="camvid-11")
        add(base, [maps / f"{row:03d}.png" for row in range(stored)])
        build(base.database)

    def town_of(name):
        if stored:
            shutil.copytree(base.path, tmp_path / name)
        return Map.open(tmp_path / name, labels_as="camvid-11")

    lines, sizes = Lines(files), set()
    lines.run(lambda: add(town_of("first"), maps))
    for at in range(1, lines.count + 1, 12):
        town = town_of(str(at))
        if not Lines(files, at).run(partial(add, town, maps)):
            break  # of the first run, lines of imports are left
        sizes.add(len(town))
        assert len(town) == (len(Database.open(town.path)) if Database.exists(town.path) else 0)
        add(town, maps)
        frames = town.database.load()
        assert frames.frames == expected.frames
        assert torch.equal(frames.descriptors, expected.descriptors)
        if at % 36 == 1:
            assert places(town.query(maps)) == answers
        shutil.rmtree(town.path)
    assert 3 in sizes and (stored or 0 in sizes)
    assert [entry.name for entry in tmp_path.glob(".*")] == []
