"""Material: what reports show of frames, read when they ask, and the picture of answers, without
ground truth, which needs the extra ``eval`` (matplotlib)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..channels.channel import Channel
from ..database.database import Database
from ..database.frames import FrameRecord, FrameSet
from ..database.rows import folder_of
from ..datasets.dataset import GroundTruth
from ..datasets.frame_files import FrameFile, found_by
from ..datasets.image_files import Pixels, find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..encoding.source import SelectedFrames
from ..evaluation.curves import Rows
from ..evaluation.ground_truth import Viewpoints, from_frame_numbers, true_matches
from ..evaluation.loops import EVEN
from ..evaluation.measure import Evaluation, Recognition, measure
from ..evaluation.metrics import Convention
from ..evaluation.trajectory import draw_trajectory
from ..files import drawn_text, new_figure
from ..recognition.recognise import references_of
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, colourise, label_space
from .answers import Answers
from .exact import chosen_channels
from .index import read_rows
from .selection import Near, Posed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PHOTO, LABELS = "photo", "label map"


@dataclass(frozen=True)
class Material:
    """The cosines of queries and of the frames of a map, and their photos and coloured label maps.
    The ``channel`` compares; ``references`` are without descriptors if the map is large;
    ``queries`` are ``(Q, *shape)`` descriptors of frames of the ``source``."""

    database: Database
    channel: Channel
    references: FrameSet
    queries: Tensor
    source: SelectedFrames

    @classmethod
    def of(cls, database: Database, answers: Answers, source: SelectedFrames) -> Self:
        """The material of answers to the frames of a source."""
        [channel] = chosen_channels(database, [next(iter(answers.queries.channels))])
        return cls(database, channel, answers.references, answers.queries.descriptors, source)

    def of_queries(self, queries: Rows) -> Self:
        """The same of the queries of these rows."""
        return replace(self, queries=self.queries[queries])

    def cosines(self, queries: Rows, references: Rows) -> npt.NDArray[np.float32]:
        """``(n, m)`` of n queries and m references, single frames, by their rows."""
        name = self.channel.column.name
        if self.references.channels:
            stored = self.references.channels[name][references]
        else:
            order = self.database.placed()[1][references]
            stored = read_rows(self.database, order, [self.channel.column])[name]
        town = references_of({name: stored}, [""] * len(stored))
        scores, _ = town.compare({name: self.queries[queries].numpy()})
        return scores

    def query(self, frame: str) -> Mapping[str, Pixels]:
        """The pictures ``(H, W, 3)`` RGB of a query by what they are; the network labels photos."""
        file, source = self._files.get(frame), self.source
        if file is None:
            return {}
        space = label_space(source.labels_as)
        return dict(_pictures(file, space, source.segmenter, self._photos.get(frame)))

    def reference(self, frame: str) -> Mapping[str, Pixels]:
        """The pictures of a frame of the map, from the file that it was encoded from; none of a
        file that has changed or is gone."""
        record = self._stored[frame]
        file = self._files_in(folder_of(record.signature)).get(record.signature + record.name)
        origin = self.database.origins.get(record.origin)
        if file is None or origin is None or origin.label_space is None:
            return {}
        network = self.source.segmenter if origin.segmenter else None
        if origin.segmenter and (network is None or network.label_space != origin.label_space):
            return dict(_photo(file))
        return dict(_pictures(file, origin.label_space, network, self._photos.get(frame)))

    @cached_property
    def _files(self) -> dict[str, FrameFile]:
        return {file.frame: file for file in self.source.files}

    @cached_property
    def _stored(self) -> Mapping[str, FrameRecord]:
        return self.database.known()

    @cached_property
    def _photos(self) -> dict[str, FrameFile]:
        """The images of the data set by id, without files that may be label maps."""
        return {
            frame.frame: FrameFile(frame.sequence, frame.name, frame.image)
            for frame in (self.source.dataset.frames if self.source.dataset else ())
            if frame.image and frame.image != frame.label
        }

    @cached_property
    def _folders(self) -> dict[str, dict[str, FrameFile]]:
        return {}

    def _files_in(self, folder: str) -> dict[str, FrameFile]:
        if folder not in self._folders:
            files = [
                f for find in (find_image_files, find_label_files) for f in found_by(find, [folder])
            ]
            files += [replace(file, index_is_id=True) for file in files]
            self._folders[folder] = {file.signature() + file.name: file for file in files}
        return self._folders[folder]


def _pictures(
    file: FrameFile, space: LabelSpace, segmenter: Segmenter | None, photo: FrameFile | None
) -> Iterator[tuple[str, Pixels]]:
    """The pictures of a label map and its photo, or, with a segmenter, of a photo and its label
    map; without those that cannot be read."""
    if segmenter is None:
        if photo:
            yield from _photo(photo)
        with suppress(ValueError):
            yield LABELS, colourise(read_label_map(file, space), space)
        return
    yield from _photo(file)
    for _, labels in segmenter.label_maps([file]):
        if not isinstance(labels, ValueError):
            yield LABELS, colourise(labels, space)


def _photo(file: FrameFile) -> Iterator[tuple[str, Pixels]]:
    with suppress(ValueError):
        yield PHOTO, read_image(file)


def posed_references(
    definition: GroundTruth,
    source: SelectedFrames,
    database: Database,
    circle: Near | Posed | None,
    note: Callable[[str], object],
) -> Near | Posed | None:
    """The references in a circle, if there is one, and of known pose, if a definition of a true
    match leaves out others; ``note`` gets the number of these. A distance in frames that cannot be
    told is a ValueError."""
    if definition.frames is not None and source.files:
        counted = Viewpoints.of(source.files, source.dataset).counted
        stored = Viewpoints.of_set(database.placed()[0], source.dataset, ()).counted
        from_frame_numbers(counted, stored, definition.frames)
    if definition.metres is None:
        return circle
    posed = Posed(definition.degrees is not None)
    is_posed = posed.rows(database.placed()[0].poses, database.path)
    if unknown := np.count_nonzero(~is_posed):
        note(f"{unknown} of {len(is_posed)} references are left out: their pose is unknown")
    return posed._replace(circle=circle) if unknown else circle


def evaluate_answers(
    answers: Answers,
    material: Material,
    definition: GroundTruth,
    convention: Convention,
    note: Callable[[str], object],
) -> Evaluation:
    """How well the frames of the source of a material were found, by a definition of a true match;
    ``note`` gets what is left out."""
    source, config = material.source, material.database.config
    skipped = [frame.frame for frame in answers.skipped]
    references = Viewpoints.of_set(answers.references, source.dataset, source.map_folders)
    queries = Viewpoints.of_set(answers.queries, source.dataset, source.folders, skipped)
    truth = true_matches(definition, references, queries, note)
    details = {
        **answers.judged(truth),
        "preset": config.preset,
        "fingerprint": config.fingerprint,
        "temporal": answers.temporal,
        "steps": answers.recognised.used,
        "score_is": " or ".join(sorted(set(answers.recognised.score_is))),
    }
    sure = answers.recognised.confidence.numpy()
    recognition = Recognition(
        references, queries, answers.matches, material,
        sure if sure.any() else None, answers.skipped, details,
    )  # fmt: skip
    return replace(measure(recognition, truth, convention), true_matches=definition.words)


EXAMPLES = 4
"""Number of queries that are shown beside their answers."""

_ACCEPTED, _DOUBTFUL = "tab:green", "tab:orange"


def draw_answers(answers: Answers, material: Material) -> Figure:
    """Draws the answers to a sequence. Accepted ones are green, doubtful ones orange: those that
    `Answers.accepted` leaves out, or without such a limit those that are more likely wrong. A map
    with poses is drawn from above, with lines from the first candidates to the queries' own poses.
    A chart shows the numbers of queries against those of candidates. Below are queries beside their
    candidates, from the surest to the most doubtful."""
    from matplotlib.collections import LineCollection

    sure = answers.recognised.confidence.numpy()
    rows = answers.recognised.matches.indices[:, 0].numpy()
    least = max(answers.estimate.confidence, EVEN)
    if answers.min_confidence or answers.max_wrong is not None:
        least = answers.estimate.confidence
    answered = np.flatnonzero(rows >= 0)
    poses, places = answers.references.poses, answers.queries.poses
    placed = bool(np.isfinite(poses[:, :2]).all(axis=1).any())
    figure = new_figure(10, 9)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    charts = above.subplots(1, 2 if placed else 1, squeeze=False)[0]
    if placed:
        draw_trajectory(charts[0], poses, answers.references.sequences, "map")
    for name, colour, chosen in (
        ("accepted", _ACCEPTED, answered[sure[answered] >= least]),
        ("doubtful", _DOUBTFUL, answered[sure[answered] < least]),
    ):
        label = f"{name}: {len(chosen)}"
        charts[-1].plot(chosen, rows[chosen], ".", ms=4, color=colour, label=label)
        if placed and len(chosen):
            ends = np.stack((poses[rows[chosen], :2], places[chosen, :2]), axis=1)
            links = [link for link in ends if np.isfinite(link).all()]
            charts[0].add_collection(LineCollection(links, colors=colour, lw=0.8, alpha=0.7))
            charts[0].plot(*ends[:, 0].T, ".", ms=4, color=colour, label=label)
    charts[-1].set(xlabel="number of the query", ylabel="number of its candidate in the map")
    above.legend(*charts[-1].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    order = answered[np.argsort(-sure[answered], kind="stable")]
    examples = np.linspace(0, len(order) - 1, min(EXAMPLES, len(order))).round().astype(int)
    for column, query in enumerate(order[examples]):
        frames = answers.queries.frames[query], answers.references.frames[rows[query]]
        pictures = material.query(frames[0]), material.reference(frames[1])
        for line, (frame, views) in enumerate(zip(frames, pictures, strict=True)):
            axes = below.add_subplot(2, EXAMPLES, line * EXAMPLES + column + 1)
            axes.set_axis_off()
            colour = _ACCEPTED if sure[query] >= least else _DOUBTFUL
            below_name = f"\nconfidence {sure[query]:.2f}" if line == 0 else ""
            axes.set_title(f"{drawn_text(frame)}{below_name}", fontsize=8, color=colour)
            for pixels in [*views.values()][:1]:
                axes.imshow(pixels)
    return figure
