"""Descriptors of a frame's picture beside that of its label map, for `recognition.fusion`."""

from __future__ import annotations

from collections.abc import Sequence

from ..baselines.hog import HOG
from ..database.metadata import ExtraDescriptor

_METHODS = {HOG.name: HOG}


def extra_descriptor(name: str) -> ExtraDescriptor:
    """The descriptor of a method of pictures, ``hog``; raises ValueError for other names."""
    if name not in _METHODS:
        raise ValueError(f"expected a method of pictures, {', '.join(_METHODS)}, got {name!r}")
    method = _METHODS[name]()
    return ExtraDescriptor(name, method.length, method.fingerprint)


def extra_methods(stored: Sequence[ExtraDescriptor]) -> list[HOG]:
    """The methods that compute the extra descriptors of a database.

    Raises:
        ValueError: a method is unknown, or computes other descriptors in this version.
    """
    for extra in stored:
        current = extra_descriptor(extra.name)
        if current != extra:
            raise ValueError(
                f"{extra.name} gives other descriptors here ({current.fingerprint}) than there "
                f"({extra.fingerprint}): encode them again"
            )
    return [_METHODS[extra.name]() for extra in stored]
