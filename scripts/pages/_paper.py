"""The numbers of the paper: Tables I and III of Nie, Feng et al., arXiv 2202.03677."""

from __future__ import annotations

COHOG, NETVLAD, REGION_VLAD, LOST_X = "CoHOG", "NetVLAD", "Region-VLAD", "LoST-X"
SSR_VLAD, UNPROCESSED = "SSR-VLAD, paper", "SSR-VLAD, paper, no pre-processing"
CMU, ROBOTCAR, SYNTHIA = "Extended CMU Seasons", "RobotCar", "SYNTHIA"

_METHODS = (COHOG, NETVLAD, REGION_VLAD, LOST_X, SSR_VLAD, UNPROCESSED)

METRICS = ("Recall@100%Precision", "RecallRate@1", "AUC")

_TABLE_I = {
    CMU: (
        ("3.1", "8.1", "10.6", "2.6", "51.8", "6.9"),
        ("92.4", "90.9", "91.4", "92.7", "81.7", "49.7"),
        ("0.896", "0.931", "0.904", "0.918", "0.961", "0.696"),
    ),
    ROBOTCAR: (
        ("9.3", "80.2", "7.2", "9.6", "38.5", "14.8"),
        ("50.8", "97.9", "87.4", "92.1", "57.7", "32.8"),
        ("0.620", "0.997", "0.944", "0.824", "0.855", "0.604"),
    ),
    SYNTHIA: (
        ("2.3", "61.6", "2.0", "-", "96.7", "98.9"),
        ("69.7", "99.3", "62.0", "-", "99.6", "99.9"),
        ("0.741", "0.998", "0.605", "-", "0.999", "0.999"),
    ),
}

TABLE_I = {
    dataset: {
        method: tuple(line[column] for line in lines) for column, method in enumerate(_METHODS)
    }
    for dataset, lines in _TABLE_I.items()
}
"""Data set, method: `METRICS`, the first two in per cent."""

TABLE_III = {
    COHOG: ("240.89/105.73/92.29", "", "2.5/1.4/0.9"),
    REGION_VLAD: ("1478.75/1250.32/1134.92", "25.174/8.013/6.906", "0.18/0.0736/0.0701"),
    SSR_VLAD: ("159.61/105.57/186.29", "1.864/1.696/1.685", "0.01/0.009/0.001"),
    "SSR-VLAD on a TDA4VM": ("709/672.658/639", "9/8.551/8", "1/0.28/0.10"),
}
"""Feature extraction, descriptor encoding and matching of each method, in ms, max/average/min. For
CoHOG, extraction includes encoding. A maximum below the minimum is as printed in the paper."""
