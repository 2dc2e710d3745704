"""The result of a frame of the loop detector."""

from typing import Any, NamedTuple

from ..native.loops import Reason


class Place(NamedTuple):
    """An old frame, and the confidence that the place is within five frames of it."""

    frame: str
    confidence: float


class LoopResult(NamedTuple):
    """The result of a frame.

    Attributes:
        frame: its id.
        reason: why it closes a loop or does not:

            - ``accepted``: the confidence reaches the threshold. The two frames look in the same
              direction: a street driven the other way is not recognised.
            - ``empty_frame``: its descriptor is zero.
            - ``no_candidate``: all earlier frames are empty, or it is the first frame.
            - ``too_recent``: fewer than two of them are old enough to be candidates; or, with a
              candidate, the place is more probably that of an excluded frame.
            - ``ambiguous``: the frame is probably at an old place, but not clearly at one of them.
            - ``below_threshold``: it is probably at a new place.
        candidate: id of the most probable old frame, or ``None``.
        score: its cosine (Eq. 4), standardised by the mean of all frames so far, or ``None``.
        confidence: probability that the place is within five frames of the candidate, or ``None``.
        ahead: distance in metres from the candidate to the frame along the candidate's drive,
            negative behind it: a mean over the frames around the candidate by their poses, weighted
            with their probabilities; ``None`` where a pose is unknown, and unless accepted.
        candidates: the most probable old places, best first, for a back end that verifies them: at
            most five, each of a confidence of at least 0.01, whatever the reason.
    """

    frame: str
    reason: Reason
    candidate: str | None = None
    score: float | None = None
    confidence: float | None = None
    ahead: float | None = None
    candidates: tuple[Place, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the frame closes a loop."""
        return self.reason is Reason.ACCEPTED

    def as_json(self) -> dict[str, Any]:
        """The fields by name, for JSON."""
        return {**self._asdict(), "candidates": [place._asdict() for place in self.candidates]}
