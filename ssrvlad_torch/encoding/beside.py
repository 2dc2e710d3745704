"""What describes the pictures of frames beside their label maps, for `recognition.fusion`."""

from __future__ import annotations

from collections.abc import Sequence

from ..baselines.hog import HOG
from ..database.metadata import Beside

_METHODS = {HOG.name: HOG}


def beside_by(name: str) -> Beside:
    """What a new database needs to know of a method of pictures, ``hog``; another name is a
    ValueError."""
    if name not in _METHODS:
        raise ValueError(f"expected a method of pictures, {', '.join(_METHODS)}, got {name!r}")
    method = _METHODS[name]()
    return Beside(name, method.length, method.fingerprint)


def methods_of(beside: Sequence[Beside]) -> list[HOG]:
    """The methods that a database names. One that gives other descriptors in this version is a
    ValueError."""
    for one in beside:
        if beside_by(one.name) != one:
            here = beside_by(one.name).fingerprint
            raise ValueError(
                f"{one.name} gives other descriptors here ({here}) than there ({one.fingerprint}): "
                "encode them again"
            )
    return [_METHODS[one.name]() for one in beside]
