#!/usr/bin/env python3
"""Writes the table of measured runtimes into export/README.md.

python scripts/pages/runtimes.py --provider CPUExecutionProvider --provider openvino

Each runtime runs the exported heads of both presets, `default` in both forms, on what `ssrvlad
verify` compares on, and on a label map of 512 x 1024 for its time.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from _markdown import head_row, row

from ssrvlad_torch import SSRVLADConfig, export_head
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.deployment.runtimes import runtime_of
from ssrvlad_torch.deployment.verify import verify

README = Path(__file__).parents[2] / "export" / "README.md"
SPACE = "cityscapes-trainids"
HEADS = {"default": "words", "default, arithmetic": "arithmetic", "paper": "words"}
"""Presets, and the form of each file."""
REPETITIONS = 5
SIZE = (512, 1024)


def table(providers: list[str]) -> Iterator[str]:
    """A row for each runtime and head."""
    yield from head_row(
        "runtime", "head", "verdict", "largest difference", "load, s", "512 x 1024, ms"
    )
    (frame,) = SyntheticCity(seed=5).traverse(1, size=SIZE, labels_as=SPACE)
    labels = frame.labels.astype(np.uint8)[None]
    with tempfile.TemporaryDirectory() as folder:
        for head, form in HEADS.items():
            file = Path(folder) / f"{head}.onnx"
            preset, _, _ = head.partition(",")
            export_head(SSRVLADConfig.from_preset(preset, labels_as=SPACE), file, form=form)
            for provider in providers:
                yield row(*measured(file, head, provider, labels))


def measured(file: Path, head: str, provider: str, labels: np.ndarray) -> tuple[str, ...]:
    """What one runtime makes of one file."""
    found = verify(file, provider=provider)
    for warning in found.warnings:
        print(f"{provider}: {warning}", file=sys.stderr)
    if found.fault:
        verdict = f"{found.verdict}: {found.fault.place}"
        return found.runtime, head, verdict, "", "", ""
    begin = time.perf_counter()
    run = runtime_of(provider).open(file)
    loaded = time.perf_counter() - begin
    taken = []
    for _ in range(REPETITIONS + 1):
        begin = time.perf_counter()
        run({"labels": labels})
        taken.append(time.perf_counter() - begin)
    milliseconds = 1e3 * statistics.median(taken[1:])
    return (
        found.runtime,
        head,
        found.verdict,
        f"{found.difference:.1g}",
        f"{loaded:.1f}",
        f"{milliseconds:.0f}",
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--provider", action="append", required=True, help="as `ssrvlad verify`")
    parser.add_argument("--readme", type=Path, default=README)
    options = parser.parse_args()
    text = "\n".join(table(options.provider))
    before, begin, rest = options.readme.read_text(encoding="utf-8").partition(
        "<!-- runtimes -->\n"
    )
    _, end, after = rest.partition("<!-- /runtimes -->")
    if not end:
        raise SystemExit(f"{options.readme} has no <!-- runtimes --> and <!-- /runtimes -->")
    where = f"Measured on {platform.system()} {platform.machine()}, the CPU."
    options.readme.write_text(f"{before}{begin}{where}\n\n{text}\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
