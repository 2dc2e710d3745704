"""Writes encoded frames to a database, many in one commit."""

import time
from contextlib import AbstractContextManager
from functools import partial

from ..database.database import Database, StagedRows
from .plan import NEW, Plan, check_folders
from .results import Encoded, EncodeOptions, Skipped, Summary, stacked

COMMIT_ROWS, COMMIT_SECONDS = 8192, 10.0
"""A commit is made after this number of frames or this time."""


class Writer(AbstractContextManager["Writer"]):
    """Collects encoded frames and commits them to a database; the last ones when it is closed."""

    def __init__(self, database: Database, plan: Plan, options: EncodeOptions) -> None:
        self.summary = Summary(already_there=plan.already_there)
        self._database = database
        self._plan = plan
        self._options = options
        self._waiting: list[Encoded] = []
        self._staged: list[StagedRows] = []
        self._due = time.monotonic() + COMMIT_SECONDS

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Commits the last frames; without an error, removes or reports those that are gone."""
        self.commit()
        if kind is None and self._options.prune:
            self._database.remove(self._plan.gone)
            self.summary.pruned = len(self._plan.gone)
        elif kind is None and self._options.complete:
            self.summary.gone = self._plan.gone

    def add(self, result: Encoded | Skipped) -> None:
        """Adds the result of a frame."""
        if isinstance(result, Skipped):
            self.summary.skipped.append(result)
            self._options.skipped(result)
        else:
            self._waiting.append(result)
            if len(self._waiting) >= COMMIT_ROWS or time.monotonic() > self._due:
                self.commit()
        self._options.progress(1)

    def add_staged(self, rows: StagedRows, empty: int) -> None:
        """Adds new frames that `Database.write_apart` wrote, ``empty`` of them empty."""
        self._staged.append(rows)
        self.summary.encoded += len(rows.frames)
        self.summary.empty += empty
        if time.monotonic() > self._due:
            self.commit()
        self._options.progress(len(rows.frames))

    def commit(self) -> None:
        """Commits the waiting frames."""
        frames, self._waiting = self._waiting, []
        staged, self._staged = self._staged, []
        check = partial(check_folders, self._plan.files)
        self._database.adopt(staged, check)
        if frames:
            self._database.merge([frame.record for frame in frames], stacked(frames), check)
            reasons = [self._plan.reason(frame.record) for frame in frames]
            self.summary.encoded += reasons.count(NEW)
            self.summary.anew.update(reason for reason in reasons if reason != NEW)
            self.summary.empty += sum(frame.is_empty for frame in frames)
        self._due = time.monotonic() + COMMIT_SECONDS
