"""Place recognition from semantic segmentation: SSR-VLAD (arXiv 2202.03677) in PyTorch.

Public names are imported at their first use, so that programs that do not need torch start fast."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config import SSRVLADConfig as SSRVLADConfig
    from .database.database import Database as Database
    from .deployment.export import export_head as export_head
    from .descriptor import SSRVLAD as SSRVLAD
    from .loops.detector import LoopDetector as LoopDetector
    from .map import Map as Map
    from .recognition.matching import match as match
    from .segmentation.segmenter import Segmenter as Segmenter
    from .soft.descriptor import SurrogateSSRVLAD as SurrogateSSRVLAD
    from .taxonomy import LabelSpace as LabelSpace

    __version__: str

_MODULES = {
    "Database": "database.database",
    "LabelSpace": "taxonomy",
    "Map": "map",
    "LoopDetector": "loops.detector",
    "SSRVLAD": "descriptor",
    "SSRVLADConfig": "config",
    "Segmenter": "segmentation.segmenter",
    "SurrogateSSRVLAD": "soft.descriptor",
    "export_head": "deployment.export",
    "match": "recognition.matching",
}
"""The module that defines each public name."""

__all__ = sorted(_MODULES)  # noqa: PLE0605 - a list of str


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module(".config", __name__).package_version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, "__version__"})
