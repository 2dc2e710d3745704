"""A map by three channels, with an index, and queries in it."""

import numpy as np
import torch
import torch.nn.functional as F
from drawings import SPACE
from helpers import descriptors

from ssrvlad_torch import SSRVLAD, Database, SSRVLADConfig
from ssrvlad_torch.channels.channel import channels_of
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.database.frames import FrameRecord, FrameSet
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.search.index import build
from ssrvlad_torch.stages.features import FORM

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)
ROWS = 400
ALL = ("ssr-vlad", "features", "hog")


def noisy(numbers, seed, noise):
    return F.normalize(numbers + noise * descriptors(seed, len(numbers)), dim=1)


def flipped(signs, seed, share):
    bits = np.random.default_rng(seed).random((*signs.shape, 8)) < share
    return signs ^ torch.from_numpy(np.packbits(bits, axis=-1)[..., 0])


def places():
    """Descriptors of `ROWS` places by three channels."""
    shape = Features(FORM).column.shape
    signs = np.random.default_rng(0).integers(0, 256, (ROWS, *shape), np.uint8)
    return {
        "ssr-vlad": descriptors(0, ROWS),
        "features": torch.from_numpy(signs),
        "hog": descriptors(1, ROWS).abs(),
    }


def seen(rows):
    """Other views of some places; label maps are described from all anchors."""
    known = {name: values[rows] for name, values in places().items()}
    swept = [noisy(known["ssr-vlad"], 10 + n, 0.5 + abs(c) / 8) for n, c in enumerate(COLUMNS)]
    return {
        "ssr-vlad": torch.stack(swept, 1),
        "features": flipped(known["features"], 3, 0.35),
        "hog": noisy(known["hog"], 4, 0.8),
    }


def queries_at(rows, names=ALL):
    count, unknown = len(rows), np.full((len(rows), 3), np.nan)
    ids = tuple(f"today/{n:03d}" for n in range(count))
    channels = {name: values for name, values in seen(rows).items() if name in names}
    return FrameSet(ids, ("today",) * count, channels, unknown, unknown[:, 0], unknown[:, 0] > 0)


def large_town(path, sequences):
    """`ROWS` frames of drives, one metre apart, with an index."""
    columns = [Features(FORM).column, HOG().column]
    database = Database.create(path, CONFIG, columns=columns)
    frames = [FrameRecord(name, f"{n:03d}", float(n), 0.0) for n, name in enumerate(sequences)]
    database.append(frames, places())
    build(database)
    return database


def channels(town, names):
    return channels_of([c for c in town.columns if c.name in names], SSRVLAD(CONFIG))
