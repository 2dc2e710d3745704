#!/usr/bin/env python3
"""Writes the table of measured runtimes into export/README.md.

python scripts/pages/runtimes.py CPUExecutionProvider openvino chromium \\
    /opt/old/bin/python:CPUExecutionProvider

Each runtime runs the exported heads of both presets on the label maps of the slow tests, and on one
of 512 x 1024 for its time. A runtime is an execution provider of ONNX Runtime, `openvino`, or
`chromium` (onnxruntime-web). `PYTHON:RUNTIME` takes another Python.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from _markdown import ROOT, commit, head_row, quote, row

sys.path.insert(0, str(ROOT / "tests"))
sys.path.append(str(ROOT / "export"))

from test_export import city, hundreds_of_label_maps

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.deployment.golden import outputs_of
from ssrvlad_torch.deployment.verify import compare
from ssrvlad_torch.files import one_line

README = ROOT / "export" / "README.md"
WORKER = Path(__file__).with_name("_one_runtime.py")
SIZE = (512, 1024)

Maps = dict[str, npt.NDArray[np.uint8]]
Arrays = dict[str, npt.NDArray[Any]]


def table(runtimes: list[str], heads: list[str]) -> Iterator[str]:
    """A row for each head and runtime."""
    yield from head_row(
        "runtime", "head", "verdict", "label maps", "largest difference", "load, s",
        "512 x 1024, one thread, ms",
    )  # fmt: skip
    by_space = {
        space: {str(number): labels for number, labels in enumerate(maps)}
        for space, maps in hundreds_of_label_maps().items()
    }
    (timed,) = city(1, 5, SIZE)
    by_space["cityscapes-trainids"]["timed"] = timed
    for head in heads:
        configs = [SSRVLADConfig.from_preset(head, labels_as=space) for space in by_space]
        expected = [
            {number: outputs_of(module, labels[None]) for number, labels in maps.items()}
            for module, maps in zip(map(SSRVLAD, configs), by_space.values(), strict=True)
        ]
        with tempfile.TemporaryDirectory() as folder:
            files = {Path(folder, f"{config.labels_as}.onnx"): config for config in configs}
            for runtime in runtimes:
                cells = row(*measured(runtime, head, files, list(by_space.values()), expected))
                print(cells, file=sys.stderr, flush=True)
                yield cells


def measured(
    runtime: str,
    head: str,
    files: dict[Path, SSRVLADConfig],
    maps: list[Maps],
    expected: list[dict[str, Arrays]],
) -> list[str]:
    """The row of a head on a runtime, with one file per label space."""
    checks = []
    for (file, config), given, wanted in zip(files.items(), maps, expected, strict=True):
        try:
            if not file.exists():
                export_head(config, file)
            found = run(runtime, file, given)
        except (RuntimeError, ValueError, AssertionError) as error:
            return [
                runtime.rpartition(":")[2],
                head,
                f"cannot run: {one_line(error)}",
                *[""] * 4,
            ]
        for number, outputs in wanted.items():
            got = {name: found[f"{number} {name}"] for name in outputs}
            checks.append(compare(number, got, outputs))
    wrong = sum(bool(check.problem) for check in checks)
    return [
        str(found["name"]),
        head,
        f"wrong on {wrong}" if wrong else "exact",
        str(len(checks)),
        f"{max(check.difference for check in checks):.1g}",
        f"{found['load']:.1f}",
        f"{1e3 * found['taken']:.0f}",
    ]


def run(runtime: str, file: Path, maps: Maps) -> Arrays:
    """Outputs of a runtime for each label map, by number and name of the output.

    Raises:
        RuntimeError: it cannot run the file.
    """
    python, _, name = runtime.rpartition(":")
    if name == "chromium":
        from _chromium import run_in_chromium

        return run_in_chromium(file, maps)
    with tempfile.TemporaryDirectory() as folder:
        given, out = Path(folder, "maps.npz"), Path(folder, "out.npz")
        np.savez(given, **maps)
        command = [python or sys.executable, str(WORKER), name, str(file), str(given), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        with np.load(out) as found:
            return dict(found)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runtime", nargs="+", help="[PYTHON:]PROVIDER, openvino or chromium")
    parser.add_argument("--head", action="append", choices=PRESETS)
    parser.add_argument("--readme", type=Path, default=README)
    options = parser.parse_args()
    text = "\n".join(table(options.runtime, options.head or sorted(PRESETS)))
    where = f"Measured at commit {commit()} on {platform.system()} {platform.machine()}, the CPU."
    quote(options.readme, "runtimes", f"\n{where}\n\n{text}\n")


if __name__ == "__main__":
    main()
