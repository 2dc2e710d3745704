"""Randomness: everything in the city has a generator of its own."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, thing: str, *key: int) -> np.random.Generator:
    """Random generator of one thing, independent of all others; the key may be negative."""
    name = zlib.crc32(thing.encode())
    return np.random.default_rng([seed, name, *(number % 2**32 for number in key)])
