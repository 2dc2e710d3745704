"""Vectors: descriptors of float numbers, compared by their cosine."""

from .channel import Channel


class VectorChannel(Channel):
    """A channel of vectors of length 1, or zero for an empty frame. A subclass defines ``name``,
    ``length`` and `describe`."""

    length: int

    @property
    def shape(self) -> tuple[int, ...]:  # type: ignore[override]
        """See `Channel`."""
        return (self.length,)
