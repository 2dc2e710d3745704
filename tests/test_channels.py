"""Channels: their columns stored, verified and exported, and the channels of columns and frames."""

from functools import partial

import numpy as np
import pyarrow as pa
import pytest
import torch
from drawings import SPACE
from helpers import descriptors, street
from networks import photo

from ssrvlad_torch import Database, LoopDetector, SSRVLADConfig
from ssrvlad_torch.channels import Column
from ssrvlad_torch.channels.channel import View, batches
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.database.exporting import export_database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.database.rows import intact
from ssrvlad_torch.loops.config import LoopConfig

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)
FRAMES = ["day/10", "day/2", "night/1"]
HOG_STORED = HOG().column
OWN = Column("own", "seven numbers", (7,))


@pytest.fixture
def made(tmp_path):
    database = Database.create(tmp_path / "town", CONFIG, columns=[OWN])
    database.append(FRAMES, both(0, 1, 3))
    return database


def both(first, second, count):
    """Descriptors of label maps and by `OWN`."""
    return {"ssr-vlad": descriptors(first, count), "own": descriptors(second, count, 7)}


def test_descriptors_of_all_channels_are_loaded_bit_for_bit_and_in_order(made):
    opened = Database.open(made.path)
    frames = opened.load()
    assert frames.frames == ("day/2", "day/10", "night/1")
    assert torch.equal(frames.descriptors, descriptors(0, 3)[[1, 0, 2]])
    assert torch.equal(frames.channels["own"], descriptors(1, 3, 7)[[1, 0, 2]])
    assert opened.columns[1:] == (OWN,)
    assert opened.info()["channels"] == {"ssr-vlad": CONFIG.fingerprint, "own": "seven numbers"}
    assert "3 frames by ssr-vlad and own" in repr(opened)
    assert "ssr-vlad and own" in repr(frames)
    opened.merge(["day/2"], both(2, 3, 1))
    assert torch.equal(opened.load().channels["own"][0], descriptors(3, 1, 7)[0])


def test_every_frame_has_all_descriptors(made):
    number = descriptors(0, 1)
    wider = {"ssr-vlad": number, "own": descriptors(0, 1, 8)}
    for vectors, message in (
        (number, "holds ssr-vlad, own of every frame, got ssr-vlad$"),
        (wider, r"own: expected \(1, 7\) for 1 frames, got \(1, 8\)"),
    ):
        with pytest.raises(ValueError, match=message):
            made.append(["day/3"], vectors)
    with pytest.raises(ValueError, match="has no descriptors by own, eight numbers"):
        made.require(CONFIG, [OWN._replace(fingerprint="eight numbers")])
    made.require(CONFIG, [OWN])
    assert len(made) == 3


def test_signs_are_bytes_on_a_grid(tmp_path):
    grid = Column("features", "signs of a network", (4, 6, 2), "uint8")
    signs = torch.randint(0, 256, (300, 4, 6, 2), dtype=torch.uint8)
    names = [f"day/{row}" for row in reversed(range(300))]
    database = Database.create(tmp_path / "town", CONFIG, columns=[grid])
    database.append(names, {"ssr-vlad": descriptors(0, 300), "features": signs})
    opened = Database.open(tmp_path / "town")
    assert opened.columns[1:] == (grid,)
    assert torch.equal(opened.load().channels["features"], signs.flip(0))
    assert opened.damage() == []
    assert opened.table().to_table()["features"].type.value_type == pa.uint8()
    assert not intact(_changed(opened.table().to_table(), "features")).all()
    number, sign = descriptors(0, 1), signs[:1]
    for numbers, wrong, message in (
        (number, sign.float(), "features: expected uint8, got float32"),
        (number, sign[:, 1:], r"features: expected \(1, 4, 6, 2\) .*, got \(1, 3, 6, 2\)"),
        (number.byte(), sign, "ssr-vlad: expected float32, got uint8"),
    ):
        with pytest.raises(ValueError, match=message):
            database.append(["day/x"], {"ssr-vlad": numbers, "features": wrong})
    export_database(opened, "npy", tmp_path / "out.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy.features.npy"), signs.flip(0))


def _changed(table, name):
    """The table with one number of a column of lists changed."""
    numbers = table[name].combine_chunks().flatten().to_numpy().copy()
    numbers[8] += 1
    place, lists = table.schema.get_field_index(name), table[name].combine_chunks()
    column = type(lists).from_arrays(numbers, lists.type.list_size)
    return table.set_column(place, table.schema.field(place), column)


# ---- loops


def test_a_detector_stores_all_channels(tmp_path):
    detector = LoopDetector(LoopConfig(exclude=2), channels=[HOG()])
    database = Database.create(tmp_path / "memory", detector.head.config, columns=[HOG_STORED])
    pictures = [photo(street(seed, 60, 80)) for seed in range(6)]
    for row, picture in enumerate(pictures):
        detector.update(torch.full((60, 80), row), f"drive/{row}", picture=picture)
    detector.save(database)
    expected = HOG().describe([View("", picture=picture) for picture in pictures])
    assert torch.equal(database.load().channels["hog"], expected)
    again, other = (LoopDetector.load(database, detector.config) for _ in range(2))
    seen = partial(LoopDetector.update, view=torch.full((60, 80), 2), picture=pictures[2])
    assert seen(again, frame_id="later/0") == seen(other, frame_id="later/0")
    with pytest.raises(ValueError, match="needs pictures, but frame later/1 has none"):
        again.update(torch.full((60, 80), 2), "later/1")
    with pytest.raises(ValueError, match="expected descriptors by ssr-vlad, hog, got ssr-vlad"):
        again.observe(FrameRecord("later", "1"), torch.zeros(480))
    with pytest.raises(ValueError, match="has no descriptors by hog"):
        detector.save(Database.create(tmp_path / "other", detector.head.config))


# ---- views: what is known of a frame, what is missing or wrong, and batches of them


def views(*sizes, labels_as="camvid-11", dtype=np.uint8):
    """Views of label maps and pictures of these widths."""
    return [
        View(f"a/{n}", np.zeros((2, width), dtype), labels_as, np.zeros((2, width, 3), np.uint8))
        for n, width in enumerate(sizes)
    ]


def test_batches_keep_the_order_and_hold_what_is_alike():
    def widths(views, size):
        return [[view.picture.shape[1] for view in batch] for batch in batches(views, size)]

    assert widths(views(*[4] * 7), 3) == [[4] * 3, [4] * 3, [4]]
    assert widths(views(1, 1, 2, 2, 2, 1), 2) == [[1, 1], [2, 2], [2], [1]]
    assert widths([], 2) == []
    unlike = [*views(4), *views(4, dtype=np.int32), *views(4, labels_as="camvid-32"), View("a/9")]
    assert [len(batch) for batch in batches(unlike, 4)] == [1] * 4
