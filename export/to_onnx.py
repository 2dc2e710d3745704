#!/usr/bin/env python3
"""Writes the head as one ONNX file; `ssrvlad export` does the same.

python export/to_onnx.py head.onnx --labels-as cityscapes-trainids --input logits
"""

from __future__ import annotations

import argparse

from ssrvlad_torch import SSRVLADConfig, export_head

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", help="file to write")
    parser.add_argument("--labels-as", required=True, help="label space: a name or a .yaml file")
    parser.add_argument("--input", default="labels", help="labels or logits")
    parser.add_argument("--dtype", default="uint8", help="of the labels: uint8, int32 or int64")
    parser.add_argument("--preset", default="default", help="paper or default")
    given = parser.parse_args()
    config = SSRVLADConfig.from_preset(given.preset, labels_as=given.labels_as)
    export_head(config, given.path, given.input, given.dtype)
