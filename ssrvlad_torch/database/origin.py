"""What made label maps: the label space as it was defined, and the segmenter."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import NamedTuple

from ..taxonomy import LabelClass, LabelSpace


class Origin(NamedTuple):
    """What made label maps.

    Attributes:
        label_space: what their ids mean, ``None`` where unknown.
        segmenter: identity of the network that made them, empty where they were there.
    """

    label_space: LabelSpace | None = None
    segmenter: str = ""

    @property
    def key(self) -> str:
        """16 hex digits over all of its content."""
        return hashlib.blake2b(self.to_json().encode(), digest_size=8).hexdigest()

    def to_json(self) -> str:
        """All of its content as text."""
        space = self.label_space and dataclasses.asdict(self.label_space)
        return json.dumps({"label_space": space, "segmenter": self.segmenter}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Origin:
        """What `to_json` wrote."""
        content = json.loads(text)
        return cls(_space(content["label_space"]), content["segmenter"])


def _space(content: dict[str, object] | None) -> LabelSpace | None:
    if content is None:
        return None
    classes = content.pop("classes")
    assert isinstance(classes, list)
    coloured = [{**c, "colour": c["colour"] and tuple(c["colour"])} for c in classes]
    return LabelSpace(**content, classes=tuple(LabelClass(**c) for c in coloured))  # type: ignore[arg-type]
