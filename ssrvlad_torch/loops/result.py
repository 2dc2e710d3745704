"""What became of a frame that was shown to the loop detector."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Reason(StrEnum):
    """Why a frame closes a loop or does not; see `LoopResult`."""

    ACCEPTED = "accepted"
    EMPTY_FRAME = "empty_frame"
    NO_CANDIDATE = "no_candidate"
    TOO_RECENT = "too_recent"
    IMPLAUSIBLE = "implausible"
    BELOW_THRESHOLD = "below_threshold"
    AMBIGUOUS = "ambiguous"
    INCONSISTENT = "inconsistent"
    DISPROVED = "disproved"


class LoopResult(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: its id.
        reason: ``accepted`` if all checks are passed, else the first that is not:

            - ``empty_frame``: its descriptor is zero.
            - ``no_candidate``: no frame came before, or none but empty ones.
            - ``too_recent``: all earlier frames are too recent to be candidates.
            - ``implausible``: the pose gate lets no candidate pass.
            - ``below_threshold``: the best candidate is not alike enough.
            - ``too_recent`` again, with a candidate: its place has not been left since.
            - ``ambiguous``: another place is nearly as much alike.
            - ``inconsistent``: the candidates of the frames before were elsewhere.
            - ``disproved``: the geometric check said no.
        candidate: id of the best candidate, ``None`` if there is none.
        score: its cosine, or ``None``.
        strength: what was held against the threshold, see `LoopConfig`, or ``None``.
    """

    frame: str
    reason: Reason
    candidate: str | None = None
    score: float | None = None
    strength: float | None = None

    @property
    def accepted(self) -> bool:
        """Whether the frame closes a loop."""
        return self.reason is Reason.ACCEPTED
