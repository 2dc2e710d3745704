"""``ssrvlad evaluate``."""

from dataclasses import replace
from pathlib import Path

from ...encoding.selection import FrameSelection
from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, TruthOptions, Verbose, option
from ..output import finish, note, print_json, progress_bar, say


def evaluate(
    *,
    database: DatabaseFolder,
    source: FrameSelection,
    recognition: RecognitionOptions,
    truth: TruthOptions,
    as_of: AsOf = None,
    as_json: Json = False,
    report: Path | None = option(
        "Page to write (.html): metrics, the curve, and matches with their pictures."
    ),
    verbose: Verbose = False,
) -> None:
    """Measure place recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals over blocks of neighbouring queries. A table shows precision and recall at
    several thresholds of the confidence; the suggested one is for --min-confidence of ssrvlad
    query and locate.
    ssrvlad compare measures other methods.

    Example: ssrvlad evaluate town.ssrdb maps/today --tolerance-metres 5
    """
    from ...files import check_output
    from ...map import Map
    from ..summaries import print_metrics, write_page

    if report:
        check_output(report)
    town = Map.open(database, version=as_of)
    by_poses = None if truth.definition == (None,) * 4 else truth.tolerance_metres is not None
    frames = town.source(replace(source, posed=by_poses), compared=True, note=note)
    with progress_bar("encoding", len(frames.files), "recognising") as bar:
        settings = {**vars(truth), **recognition.settings()}
        evaluation = town.evaluate(frames, note=note, progress=bar.advance, **settings)
    if as_json:
        print_json(evaluation.metrics)
    else:
        print_metrics(evaluation.metrics, verbose)
    if report:
        write_page(report, evaluation, database, source.paths)
        if not as_json:
            say(f"report: {report}")
    finish(evaluation.recognition.skipped, len(evaluation.truth) + evaluation.left_out)
