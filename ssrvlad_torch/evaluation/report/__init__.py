"""An evaluation as one self-contained HTML page, which opens without a server."""

from .contents import Descriptors, Picture, Report
from .page import require_place, write_report
from .scores import cosine_scores, stored_scores

__all__ = [
    "Descriptors",
    "Picture",
    "Report",
    "cosine_scores",
    "require_place",
    "stored_scores",
    "write_report",
]
