"""How well the right rows fit tells where the stream leaves an old drive."""

import numpy as np
import pytest
from loop_streams import signs_of, views

from ssrvlad_torch.loops.reference import Loops as Reference
from ssrvlad_torch.native.loops import Channel, Loops

SHAPES, SIGNS = Channel("ssr-vlad", (480,)), Channel("features", (16, 2, 8), "uint8", 6.0)


def accepted(form, channels):
    """Which frames of a second drive close a loop: 40 at old places, 40 at new ones."""
    loops = form(channels)
    old, new = views(range(100), 0.02), views([*range(20, 60), *range(200, 240)], 0.02)
    found = []
    for drive in (old, new):
        for number, vector in enumerate(drive):
            descriptors = {"ssr-vlad": vector, "features": signs_of(vector)}
            given = {each.name: descriptors[each.name] for each in channels}
            found.append(loops.update(given, starts=number == 0).reason == "accepted")
    return np.array(found[100:])


@pytest.mark.parametrize("form", [Loops, Reference])
def test_an_old_drive_is_left_where_it_no_longer_fits(form):
    found = accepted(form, [SHAPES, SIGNS])
    assert found[10:40].all()
    assert not found[42:].any()


def test_label_maps_alone_fit_too_unevenly_to_tell():
    assert accepted(Loops, [SHAPES])[40:50].all()
