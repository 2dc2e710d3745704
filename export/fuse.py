#!/usr/bin/env python3
"""Joins a segmentation network and the head in one ONNX file; `ssrvlad fuse` does the same.

python export/fuse.py seg.onnx place.onnx --labels-as cityscapes-trainids
"""

from __future__ import annotations

import argparse

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment.fuse import fuse

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("network", help="a name of a network, as `ssrvlad fuse` takes it")
    parser.add_argument("path", help="file to write")
    parser.add_argument("--labels-as", required=True, help="label space: a name or a .yaml file")
    parser.add_argument("--preset", default="default", help="paper or default")
    given = parser.parse_args()
    config = SSRVLADConfig.from_preset(given.preset, labels_as=given.labels_as)
    fuse(given.network, config, given.path)
