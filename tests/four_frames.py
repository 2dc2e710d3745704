"""A database of four frames, for the tests of databases."""

from helpers import descriptors, record

from ssrvlad_torch import Database, SSRVLADConfig

CONFIG = SSRVLADConfig.from_preset("default", labels_as="camvid-11")
FRAMES = ["day/10", "day/2", "night/1", "day/9"]
SORTED = ("day/2", "day/9", "day/10", "night/1")


def fill(into, frames, seed=0):
    into.append([record(frame) for frame in frames], descriptors(seed, len(frames)))


def loaded(path, **which):
    frames = Database.open(path, **which).load()
    return dict(zip(frames.frames, frames.descriptors.tolist(), strict=True))


def filled(folder):
    """The path of a database with `FRAMES`."""
    fill(Database.create(folder / "town.ssrdb", CONFIG), FRAMES)
    return folder / "town.ssrdb"
