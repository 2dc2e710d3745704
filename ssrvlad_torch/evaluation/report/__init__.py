"""An evaluation as one self-contained HTML page, which opens without a server."""

from .contents import Descriptors, Picture, Pictures, Report
from .page import write_report
from .scores import cosine_scores, stored_scores

__all__ = [
    "Descriptors",
    "Picture",
    "Pictures",
    "Report",
    "cosine_scores",
    "stored_scores",
    "write_report",
]
