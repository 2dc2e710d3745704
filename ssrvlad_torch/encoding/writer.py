"""Where encoded frames go: into a database, from time to time."""

from __future__ import annotations

import time

import torch

from ..database.database import Database, Written
from .plan import NEW, Plan
from .results import Encoded, EncodeOptions, Skipped, Summary

COMMIT_ROWS, COMMIT_SECONDS = 8192, 10.0
"""Frames are put into the database when there are so many, or when so long has passed."""


class Writer:
    """Puts frames into a database from time to time; the last ones at the end."""

    def __init__(self, database: Database, plan: Plan, options: EncodeOptions) -> None:
        self.summary = Summary(already_there=plan.already_there)
        self._database = database
        self._plan = plan
        self._options = options
        self._waiting: list[Encoded] = []
        self._apart: list[Written] = []
        self._due = time.monotonic() + COMMIT_SECONDS

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.commit()

    def add(self, result: Encoded | Skipped) -> None:
        """Takes the result of a frame."""
        if isinstance(result, Skipped):
            self.summary.skipped.append(result)
            self._options.skipped(result)
        else:
            self._waiting.append(result)
            if len(self._waiting) >= COMMIT_ROWS or time.monotonic() > self._due:
                self.commit()
        self._options.progress(1)

    def add_written(self, written: Written, empty: int) -> None:
        """Takes new frames that `Database.write_apart` wrote, ``empty`` of them empty."""
        self._apart.append(written)
        self.summary.encoded += len(written.frames)
        self.summary.empty += empty
        if time.monotonic() > self._due:
            self.commit()
        self._options.progress(len(written.frames))

    def commit(self) -> None:
        """Puts the waiting frames into the database."""
        frames, self._waiting = self._waiting, []
        apart, self._apart = self._apart, []
        self._database.adopt(apart)
        if frames:
            descriptors = torch.stack([frame.descriptor for frame in frames])
            beside = {n: torch.stack([f.beside[n] for f in frames]) for n in frames[0].beside}
            self._database.merge([frame.record for frame in frames], descriptors, beside)
            reasons = [self._plan.reason(frame.record) for frame in frames]
            self.summary.encoded += reasons.count(NEW)
            self.summary.anew.update(reason for reason in reasons if reason != NEW)
            self.summary.empty += int((~descriptors.any(dim=1)).sum())
        self._due = time.monotonic() + COMMIT_SECONDS

    def finish(self) -> Summary:
        """Removes the frames that are gone, or reports them."""
        if self._options.prune:
            self._database.remove(self._plan.gone)
            self.summary.pruned = len(self._plan.gone)
        elif self._options.complete:
            self.summary.gone = self._plan.gone
        return self.summary
