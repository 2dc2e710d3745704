"""What is read of a database."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace
from . import engine
from .frame_sets import FRAME_SET_COLUMNS, frame_set, load_frame_set, order_of
from .frames import FrameSet
from .metadata import ExtraDescriptor, Meta, Origin
from .reading import Damage, read_rows
from .rows import DESCRIPTOR, RECORD_COLUMNS, Shape, StoredRecords, folders_of

if TYPE_CHECKING:
    from lance import LanceDataset


class Version(NamedTuple):
    """One version of a database: its number, for ``open``, when it was made, the number of frames
    in it, and the change that made it."""

    version: int
    time: datetime
    frames: int
    change: str


class StoredFrames:
    """One version of a table of frames; `Database` documents the attributes."""

    def __init__(self, path: str, table: LanceDataset) -> None:
        self.path = path
        self._use(table)

    def _use(self, table: LanceDataset) -> None:
        self._table, self.version = table, int(table.version)
        self._config, self.extra, self.origins = Meta.of(table.schema.metadata or {}, self.path)
        self.fingerprint = self._config.fingerprint if self._config else ""
        self.width = int(table.schema.field(DESCRIPTOR).type.list_size)
        self._shapes: dict[str, Shape] = {DESCRIPTOR: (self.width,)}
        self._shapes |= {each.name: each.shape for each in self.extra}

    def __len__(self) -> int:
        return int(self.table().count_rows())

    def __bool__(self) -> bool:
        """True, even without frames."""
        return True

    def __repr__(self) -> str:
        kind = f"fingerprint {self.fingerprint}" if self.fingerprint else "without settings"
        extra = "".join(f" and {each.name}" for each in self.extra)
        return (
            f"<Database {self.path}: {len(self)} frames, descriptors of {self.width}{extra}, "
            f"{kind}, version {self.version}>"
        )

    @property
    def config(self) -> SSRVLADConfig:
        """The settings of all descriptors.

        Raises:
            ValueError: the descriptors are custom, without settings.
        """
        if self._config is None:
            raise ValueError(f"{self.path} holds custom descriptors, without settings")
        return self._config

    def label_spaces(self) -> list[LabelSpace]:
        """The label spaces of the frames, or of the origins of an empty database, each once."""
        keys = self._columns(["origin"])["origin"].unique().to_pylist() or list(self.origins)
        found = (self.origins.get(key, Origin()).label_space for key in keys)
        return list({space.digest: space for space in found if space}.values())

    def require(self, config: SSRVLADConfig, extra: Sequence[ExtraDescriptor] = ()) -> None:
        """Requires descriptors made with these settings.

        Args:
            config: the settings.
            extra: extra descriptors that every frame must have.

        Raises:
            ValueError: the settings differ, shown with both fingerprints, or an extra descriptor is
                missing.
        """
        for each in extra:
            if each not in self.extra:
                others = ", ".join(f"{other.name}, {other.fingerprint}" for other in self.extra)
                raise ValueError(
                    f"{self.path} has no descriptors by {each.name}, {each.fingerprint}, but "
                    f"{others or 'none'}: they can only be added when a database is created"
                )
        if config.fingerprint == self.fingerprint:
            return
        stored, expected = self.config.to_dict(), config.to_dict()
        differing = [
            f"{name} {stored[name]} there and {expected[name]} here"
            for name in stored
            if name != "labels_as" and stored[name] != expected[name]
        ]
        raise ValueError(
            f"{self.path} has fingerprint {self.fingerprint} ({self.config.preset}), these "
            f"settings have {config.fingerprint} ({config.preset}): {'; '.join(differing)}"
        )

    def known(self) -> StoredRecords:
        """The records of all frames, without their descriptors."""
        return StoredRecords(self._columns(RECORD_COLUMNS))

    def folders(self) -> set[tuple[str, str]]:
        """See `folders_of`."""
        return folders_of(self._columns(["signature", "sequence"]))

    def placed(self) -> tuple[FrameSet, npt.NDArray[np.int64]]:
        """All frames as from `load`, but without descriptors and not verified, and ``(R,)`` the
        row of each in the order in which rows are stored."""
        table = self._columns(FRAME_SET_COLUMNS)
        order = order_of(table)
        none = np.empty((len(order), 0), np.float32)
        return frame_set(table.take(order), {DESCRIPTOR: none}), order

    def load(self) -> FrameSet:
        """Loads all frames into memory and verifies every byte.

        Raises:
            ValueError: a row or a file is missing or damaged; the message names it.
        """
        return load_frame_set(self.table(), self._shapes)

    def damage(self, progress: Callable[[int], object] | None = None) -> list[Damage]:
        """Reads everything and reports all damage.

        Args:
            progress: called with the number of frames done since the last call.
        """
        found: list[Damage] = []
        for batch in read_rows(self.table(), found):
            if progress:
                progress(len(batch))
        return found

    def table(self) -> LanceDataset:
        """The version that is read, as a table of Lance, for what this class does not offer."""
        engine.require_unforked()
        return self._table

    def history(self) -> list[Version]:
        """The versions that are stored, the oldest first."""
        versions = list[Version]()
        for entry in engine.versions_of(self.table()):
            number, frames = entry["version"], int(entry["metadata"]["total_rows"])
            change = engine.change_of(self.table(), number)
            versions.append(Version(number, entry["timestamp"], frames, change))
        return versions

    def info(self) -> dict[str, Any]:
        """Counts and settings of the database, ready for JSON; rows are not verified."""
        table = self._columns(["sequence", "x", "empty", "origin"])
        origins = {
            str(self.origins.get(key, Origin())): count
            for key, count in Counter(table["origin"].to_pylist()).items()
        }
        config = self._config
        return {
            "frames": len(table),
            "sequences": dict(Counter(table["sequence"].to_pylist())),
            "empty": int(np.count_nonzero(table["empty"].to_numpy())),
            "with_pose": int(np.count_nonzero(~np.isnan(table["x"].to_numpy()))),
            "label_spaces": origins,
            "width": self.width,
            "preset": config.preset if config else None,
            "fingerprint": self.fingerprint,
            "extra": {each.name: each.fingerprint for each in self.extra},
            "config": {**config.to_dict(), "labels_as": config.labels_name} if config else None,
            "version": self.version,
        }

    def _columns(self, names: list[str]) -> pa.Table:
        table = self.table()
        try:
            return table.to_table(columns=names, scan_in_order=True)
        except (OSError, ValueError, RuntimeError) as error:
            raise ValueError(f"{self.path} is damaged: {engine.message_of(error)}") from error
