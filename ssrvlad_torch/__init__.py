"""Place recognition from semantic segmentation: SSR-VLAD (arXiv 2202.03677) in PyTorch."""

from .config import SSRVLADConfig
from .descriptor import SSRVLAD

__all__ = ["SSRVLAD", "SSRVLADConfig"]
__version__ = "0.1.0"
