"""The tracker of the core, ``ssrvlad_map.h``, on arrays: queries of a sequence one by one."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import failure, require, required
from .headers import number
from .map import Array, Call, Decision, DescriptorMap, Target


class DescriptorTracker:
    """Places the queries of a sequence as they come. `DescriptorMap.query` with ``follow="online"``
    is a tracker that runs over all of them.

    Args:
        town: the map; it must not change.
        standardise, sweep, delay, top, allowed: see `DescriptorMap.query`.
        threads: that share the rows.

    Raises:
        ValueError: the map has no channel, or a setting is out of range.
        MemoryError: memory is short.

    Examples:
        >>> import numpy as np
        >>> from ssrvlad_torch.native.map import DescriptorMap
        >>> from ssrvlad_torch.native.tracker import DescriptorTracker
        >>> frames = np.eye(40, dtype=np.float32)
        >>> town = DescriptorMap([40])
        >>> town.add("shapes", frames)
        >>> tracker = DescriptorTracker(town)
        >>> tracker.update({"shapes": frames[5]})[1].rows[0, 0]
        5
    """

    def __init__(
        self,
        town: DescriptorMap,
        standardise: bool = True,
        sweep: bool = True,
        delay: int = 0,
        top: int = 5,
        allowed: Array | None = None,
        threads: int = 1,
    ) -> None:
        self._settings = standardise, sweep, "online", delay, top
        self._town, self._threads, core = town, threads, required()
        nothing = {name: town.no_queries(name) for name in town.channels}
        call = Call(town, nothing, self._settings, allowed, None)  # it holds what steps point to
        self._tracker = core.ssrvlad_tracker_new_for(number("INTERFACE"), town.address, call.steps)
        if not self._tracker:
            raise failure()
        weakref.finalize(self, core.ssrvlad_tracker_free, ctypes.c_void_p(self._tracker))

    @property
    def count(self) -> int:
        """How many queries it has taken: the number that the next one gets."""
        return int(required().ssrvlad_tracker_count(self._tracker))

    def update(self, queries: Mapping[str, Array]) -> tuple[int, Decision] | None:
        """Takes the next query.

        Args:
            queries: its descriptors by the name of each channel of the map, ``(*shape,)``; of
                vectors also from several anchors, ``(S, D)``, as many for each query.

        Returns:
            The number of a query, from 0, and what is decided of it: of the newest one, or with a
            delay of the one so many queries before; ``None`` if there is none yet.

        Raises:
            ValueError: the channels are not those of the map.
            MemoryError: memory is short; the tracker refuses to go on.
        """
        one = {name: np.asarray(array)[None] for name, array in queries.items()}
        call = Call(self._town, one, self._settings, None, None)
        return self._answer("ssrvlad_tracker_update", call.queries, ctypes.c_int(self._threads))

    def finish(self) -> list[tuple[int, Decision]]:
        """The answers to the queries that wait for later ones, by those that there are."""
        answers = []
        while answer := self._answer("ssrvlad_tracker_finish"):
            answers.append(answer)
        return answers

    def save(self) -> bytes:
        """The state. A new tracker of this map with these settings that loads it gives the same
        answers to later queries, to the bit."""
        save = required().ssrvlad_tracker_save
        size = save(self._tracker, None, 0)
        if size < 0:
            raise failure()
        state = np.empty(size, np.uint8)
        save(self._tracker, state.ctypes.data, size)
        return state.tobytes()

    def load(self, state: bytes | bytearray) -> None:
        """Goes on from a state that `save` gave. One of another map or with other settings, a
        damaged one, and a tracker that has seen a query are a ValueError."""
        load = required().ssrvlad_tracker_load
        require(load(self._tracker, bytes(state), len(state)), "the state")

    def _answer(self, name: str, *arguments: Any) -> tuple[int, Decision] | None:
        target = Target(1, self._settings[-1], self._town.channels)
        query = ctypes.c_int64()
        results = target.decision, target.steps, ctypes.byref(query)
        require(getattr(required(), name)(self._tracker, *arguments, *results))
        return None if query.value < 0 else (query.value, target.decided())
