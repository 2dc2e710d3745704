"""What made label maps: the label space as it was defined, and the segmenter."""

from __future__ import annotations

import hashlib
import json
from typing import NamedTuple

from ..taxonomy import LabelSpace


class Origin(NamedTuple):
    """What made label maps.

    Attributes:
        label_space: what their ids mean, ``None`` where unknown.
        segmenter: identity of the network that made them, empty where they were there.
        network: name of that network, to be opened by; empty where unknown. No part of the key.
    """

    label_space: LabelSpace | None = None
    segmenter: str = ""
    network: str = ""

    @property
    def key(self) -> str:
        """16 hex digits, equal where the segmenter and the `LabelSpace.digest` are."""
        content = [self.label_space and self.label_space.digest, self.segmenter]
        return hashlib.blake2b(json.dumps(content).encode(), digest_size=8).hexdigest()

    def to_json(self) -> str:
        """All of its content as text."""
        space = self.label_space and self.label_space.to_dict()
        content = {"label_space": space, "segmenter": self.segmenter, "network": self.network}
        return json.dumps(content, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Origin:
        """What `to_json` wrote."""
        content = json.loads(text)
        space = content["label_space"]
        space = space and LabelSpace.from_dict(space)
        return cls(space, content["segmenter"], content.get("network", ""))
