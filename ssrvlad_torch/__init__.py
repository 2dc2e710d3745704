"""Place recognition from semantic segmentation: SSR-VLAD (arXiv 2202.03677) in PyTorch."""

from .config import SSRVLADConfig
from .database import Database
from .descriptor import SSRVLAD
from .loop_closure import LoopDetector
from .loops.config import LoopConfig
from .matching import match

__all__ = ["SSRVLAD", "Database", "LoopConfig", "LoopDetector", "SSRVLADConfig", "match"]
__version__ = "0.1.0"
