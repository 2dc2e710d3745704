#!/usr/bin/env python3
"""Compares an exported or fused ONNX file with the module; `ssrvlad verify` does the same.

python export/verify.py place.onnx --labels maps/monday
"""

from __future__ import annotations

import argparse
import sys

from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.deployment.verify import verify

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="file to check")
    parser.add_argument("--labels", action="append", help="folder, glob or file of label maps")
    parser.add_argument("--provider", default="CPUExecutionProvider", help="of ONNX Runtime")
    given = parser.parse_args()
    files = find_label_files(given.labels) if given.labels else []
    found = verify(given.model, files, given.provider)
    for name, difference, problem in found.checks:
        print(f"{name}: {problem or 'equal'}, largest difference {difference:.2g}")
    for trouble in (*found.problems, *(f"skipped {frame}: {why}" for frame, why in found.skipped)):
        print(trouble, file=sys.stderr)
    sys.exit(0 if found.passed else 1)
