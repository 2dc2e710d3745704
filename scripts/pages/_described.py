"""The one harness of pages of recognition: drives described by every method, searched, judged.

Drives are those of `conditions.py`, and others that a page adds. ``networks`` beside the drives
holds the networks, for features and LoST-X: pictures are fed with a shorter side of 576 pixels.
Descriptors are cached on disk, by drive and method: a second run takes minutes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import conditions
import numpy as np
import torch
from conditions import NETWORKS, TRAIN_IDS, Drive, Search
from torch import Tensor

from ssrvlad_torch import SSRVLAD, baselines
from ssrvlad_torch.baselines.channel_methods import EncoderFeatures, LabelGrid
from ssrvlad_torch.baselines.lost_x import LoSTX
from ssrvlad_torch.channels.channel import Channel
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.names import sequence_of
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.evaluation.ground_truth import from_poses
from ssrvlad_torch.native.map import DescriptorMap
from ssrvlad_torch.recognition.recognise import Steps, references_of
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.segmenter import Segmenter

OURS = "SSR-VLAD, default"
PRESETS = {"SSR-VLAD, paper": "paper", OURS: "default"}
FEATURES, LOST_X, TOGETHER = "features", "LoST-X", "together"
FUSED = {
    TOGETHER: {"features": FEATURES, "hog": "HOG"},
    "without HOG": {"features": FEATURES},
    "without features": {"hog": "HOG"},
}
"""What is fused with `default`, by its name in a database: all that `encode` stores, and parts."""

METHODS = (
    *("SSR-VLAD, paper", OURS, "label grid", "HOG", "CoHOG", "tiny image"),
    *(FEATURES, LOST_X, TOGETHER),
)
OF_NETWORKS = (FEATURES, LOST_X, *FUSED)
OF_PICTURES = ("HOG", "CoHOG", "tiny image", *OF_NETWORKS)
BY_SCORES = ("CoHOG", "tiny image", LOST_X)
"""Their encodings are not vectors, so the steps use their scores."""

LAST = {
    "espnetv2": "/n/level4.6/module_act/PRelu_output_0",
    "dabnet": "/bn_prelu_3/acti/PRelu_output_0",
}
"""The last activation of each encoder: what the authors of LoST-X took of theirs."""

ALONE = Steps(standardise=False, follow=None)
"""Each query as a picture of which nothing else is known, as `locate` takes it."""


class Condition(NamedTuple):
    """Searches whose queries count together."""

    dataset: str
    name: str
    searches: list[Search]

    @property
    def title(self) -> str:
        """Data set and name."""
        return f"{self.dataset}: {self.name}"

    @property
    def network(self) -> str | None:
        """The network of queries and references, if it is one of `NETWORKS`."""
        search = self.searches[0]
        names = {network_of(name) for name in (search.queries, search.references)}
        return names.pop() if len(names) == 1 else None

    def suits(self, method: str) -> bool:
        """Whether the condition has what a method needs."""
        if method in OF_NETWORKS:
            return self.network is not None
        return method not in OF_PICTURES or self.dataset != "City"


def network_of(drive: str) -> str | None:
    """The network of a drive by its name, see `Described.drive`."""
    words = drive.replace("predicted_", "").split(" ")
    return next((name for name in NETWORKS if name in words), None)


@dataclass
class Described:
    """Descriptors of drives by every method, cached.

    Args:
        data: folder of the real data sets; without it, only the city is measured.
        cache: folder of the cached descriptors.
        added: other drives by name, read when they are first used.
        shorter_side: of pictures that networks get; None for the size of the network.
    """

    data: Path | None
    cache: Path
    added: dict[str, Callable[[], Drive]] = field(default_factory=dict)
    shorter_side: int | None = 576
    _known: dict[str, Any] = field(default_factory=dict)

    def drive(self, name: str) -> Drive:
        """A drive: ``city SEED CONDITION NUMBER``, ``camvid KIND``, ``real NETWORK FOLDER``, or one
        of `added`."""
        if name in self.added:
            return self.added[name]()
        kind, _, rest = name.partition(" ")
        if kind == "city":
            seed, _, condition = rest.partition(" ")
            if condition == "reference":
                return conditions.city(int(seed), REFERENCE)
            named, _, number = condition.rpartition(" ")
            return conditions.city(int(seed), conditions.CITY_CONDITIONS[named][int(number)])
        assert self.data
        if kind == "camvid":
            return conditions.camvid(self.data / "camvid", rest)
        network, _, folder = rest.partition(" ")
        return conditions.real(self.data / folder, network)

    def add(self, name: str, files: Sequence[FrameFile], make: Callable[[], Drive]) -> None:
        """A drive whose frames are known before it is read."""
        self.added[name] = make
        self._known[f"{name} places"] = conditions.places_of(files)

    def about(self, name: str) -> tuple[tuple[str, ...], np.ndarray]:
        """Ids and poses of a drive's frames."""

        def look() -> tuple[tuple[str, ...], np.ndarray]:
            drive = self.drive(name)
            return drive.frames, drive.poses

        return self.kept(f"{name} places", look)

    def vectors(self, name: str, method: str) -> Tensor:
        """``(N, D)`` of a drive, of `default` ``(N, S, D)`` over `sweep.COLUMNS`."""
        if method not in PRESETS:
            form = " alike" if method == FEATURES else ""  # an earlier one had no name
            if not self.shorter_side and method in OF_NETWORKS:
                form += " at its own size"
            made = partial(self.make, method, network_of(name))
            return self.kept(
                f"{name} {method}{form}", lambda: made().encode_query(self.drive(name).seen())
            )
        version = head(method, "camvid-11").config.fingerprint
        return self.kept(f"{name} {method} {version}", lambda: swept(self.drive(name), method))

    def make(self, method: str, network: str | None = None) -> baselines.Method:
        """A method of `baselines` by its name in the pages; features and LoST-X of a network of
        `NETWORKS`."""
        if network and method == FEATURES:
            return EncoderFeatures(self.segmenter(network))
        if network and method == LOST_X:
            return LoSTX(self.segmenter(network, LAST[network]))
        return baselines.make(method.lower().replace(" ", "-"))

    def segmenter(self, network: str, activation: str | None = None) -> Segmenter:
        """A network, with one of its activations as features."""
        assert self.data
        named = open_network(self.data / "networks" / f"{network}.yaml")
        features = (activation,) if activation else None
        config = replace(named.config, features=features or named.config.features)
        if self.shorter_side:
            config = replace(named.config, size=self.shorter_side, multiple=16, features=features)
        return Segmenter(named.network, TRAIN_IDS, config)

    def pair(self, search: Search, method: str) -> tuple[Tensor, Tensor]:
        """Vectors of the queries and of the references of a search."""
        queries, references = (self.vectors(name, method) for name in search[:2])
        if references.ndim == 3:
            references = references[:, COLUMNS.index(0)]
        here, there = self.rows(search)
        return queries[here], references[there]

    def members(
        self, search: Search, method: str, sequences: Sequence[str]
    ) -> tuple[dict[str, Tensor], DescriptorMap]:
        """The queries and the map that `recognise` takes, by a method, or by `default` and what is
        fused with it; ``sequences`` of the references."""
        fused = {OURS: OURS, **FUSED[method]} if method in FUSED else {method: method}
        here, there, trust = {}, {}, {}
        for name, each in fused.items():
            queries, references = self.pair(search, each)
            here[name], there[name] = queries, references
            trust[name] = channel_of(each).trust
        return here, references_of(there, sequences, trust)

    def scores(self, search: Search, method: str) -> Tensor:
        """``(Q, R)`` scores of a method whose encodings are not vectors."""

        def run() -> Tensor:
            made = self.make(method, network_of(search.queries))
            here, there = (
                self.drive(name).seen(rows)
                for name, rows in zip(search[:2], self.rows(search), strict=True)
            )
            known = made.encode_reference(there)
            return torch.cat([made.scores(made.encode_query([each]), known) for each in here])

        dropped = ("labels",) if method == LOST_X else (*NETWORKS, "labels")
        pictures = [
            " ".join(part for part in name.split() if part not in dropped)
            for name in (search.queries, search.references)
        ]
        kind = pictures if search.query_rows is None else ["camvid odd", "even"]
        return self.kept(f"{' to '.join(kind)} {method}", run)

    def rows(self, search: Search) -> tuple[list[int], list[int]]:
        """Rows of the queries and of the references in their drives."""
        given = (search.query_rows, search.reference_rows)
        here, there = (
            rows or list(range(len(self.about(name)[0])))
            for name, rows in zip(search[:2], given, strict=True)
        )
        return here, there

    def sequences(self, search: Search) -> tuple[list[str], list[str]]:
        """Sequences of the queries and of the references."""
        here, there = (
            [sequence_of(self.about(name)[0][row]) for row in rows]
            for name, rows in zip(search[:2], self.rows(search), strict=True)
        )
        return here, there

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        """What was made, in the cache by its name."""
        file = f"{name.replace(' ', '_').replace('/', '_').replace(',', '')}.pt"
        if name not in self._known:
            self._known[name] = conditions.kept(self.cache / file, make)
        return self._known[name]


@cache
def channel_of(method: str) -> Channel:
    """A method whose encodings are vectors or signs as a channel."""
    if method in PRESETS:
        return LabelShapes(head(method, "camvid-11"))
    return {FEATURES: Features("of a page"), "HOG": HOG(), "label grid": LabelGrid()}[method]


@cache
def head(method: str, labels_as: str) -> SSRVLAD:
    """SSR-VLAD with the settings of a method."""
    return SSRVLAD.from_preset(PRESETS[method], labels_as=labels_as)


def swept(drive: Drive, method: str) -> Tensor:
    """Descriptors of label maps; `default` from every anchor."""
    made = head(method, drive.labels_as)
    batches = torch.from_numpy(drive.maps).split(conditions.BATCH)
    return torch.cat([made.sweep(b, COLUMNS) if method == OURS else made(b) for b in batches])


def all_conditions(described: Described) -> Iterator[Condition]:
    """Every condition of every available data set."""
    if described.data:
        yield from real_conditions(described)
        yield from camvid_conditions(described)
    yield from city_conditions(described)


def real_conditions(described: Described) -> Iterator[Condition]:
    for (dataset, pairs), network in product(conditions.REAL.items(), NETWORKS):
        for name, (queries, references, rows) in pairs.items():
            drives = [f"real {network} {folder}" for folder in (queries, references)]
            counts = (len(described.about(drive)[0]) for drive in drives)
            truth = conditions.near_rows(*counts, rows)
            yield Condition(dataset, f"{name}, {network}", [Search(*drives, truth)])


def camvid_conditions(described: Described) -> Iterator[Condition]:
    """Odd against even frames; all frames of a stop are one place."""
    assert described.data
    places = json.loads((described.data / "camvid/same_place_odd_even.json").read_text())
    names, _ = described.about("camvid labels")
    odd, even = conditions.every_other(names, 1), conditions.every_other(names, 0)
    row_of = {names[number]: place for place, number in enumerate(even)}
    truth = [np.array([row_of[f] for f in places[names[n]]], np.int64) for n in odd]
    for name, (queries, references) in conditions.CAMVID_CONDITIONS.items():
        search = Search(f"camvid {queries}", f"camvid {references}", truth, odd, even)
        yield Condition("CamVid", name, [search])


def city_conditions(described: Described) -> Iterator[Condition]:
    for name, driven in conditions.CITY_CONDITIONS.items():
        searches = []
        for seed, number in product(conditions.CITY_SEEDS, range(len(driven))):
            here, there = f"city {seed} {name} {number}", f"city {seed} reference"
            poses = (described.about(drive)[1] for drive in (here, there))
            searches.append(Search(here, there, from_poses(*poses, conditions.METRES)))
        yield Condition("City", name, searches)
