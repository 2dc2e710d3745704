"""The report of an evaluation: one HTML page that needs no other file and no server."""

from .contents import Descriptors, Picture, Pictures, Report, cosine_scores, stored_scores
from .page import write_report

__all__ = [
    "Descriptors",
    "Picture",
    "Pictures",
    "Report",
    "cosine_scores",
    "stored_scores",
    "write_report",
]
