#!/usr/bin/env python3
"""Writes `export/ros2/ssrvlad_ros/golden.npz`: label maps for the ROS 2 node, with their
descriptors by the reference, for both presets."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.deployment.golden import golden_pair
from ssrvlad_torch.reference import describe

FILE = Path(__file__).parents[2] / "export" / "ros2" / "ssrvlad_ros" / "golden.npz"
LABELS_AS = "cityscapes-ids"


def golden() -> dict[str, np.ndarray]:
    """``(2, H, W)`` labels and ``(2, D)`` descriptors by the fingerprint of the settings."""
    arrays: dict[str, np.ndarray] = {}
    for preset in ("default", "paper"):
        head = SSRVLAD.from_preset(preset, labels_as=LABELS_AS)
        labels = golden_pair(head, "labels", "uint8")["labels"]
        ids = [item.id for item in head.label_space.classes]
        labels = np.where(np.isin(labels, ids), labels, 0).astype(np.uint8)
        described = np.stack([describe(item, head.config) for item in labels])
        arrays[f"{head.config.fingerprint} labels"] = labels
        arrays[f"{head.config.fingerprint} descriptor"] = described.astype(np.float32)
    return arrays


if __name__ == "__main__":
    np.savez_compressed(FILE, **golden())
