"""An evaluation as one self-contained HTML page, which opens without a server."""

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
