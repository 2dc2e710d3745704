"""Place recognition from semantic segmentation: SSR-VLAD (arXiv 2202.03677) in PyTorch.

Public names are imported at their first use, so that programs that do not need torch start fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config import SSRVLADConfig as SSRVLADConfig
    from .database.database import Database as Database
    from .database.frames import FrameRecord as FrameRecord
    from .database.frames import FrameSet as FrameSet
    from .datasets.image_files import find_image_files as find_image_files
    from .datasets.label_files import find_label_files as find_label_files
    from .datasets.layouts import open_dataset as open_dataset
    from .deployment.export import export_head as export_head
    from .descriptor import SSRVLAD as SSRVLAD
    from .encoding.encoder import encode_to_database as encode_to_database
    from .encoding.results import EncodeOptions as EncodeOptions
    from .loops.config import LoopConfig as LoopConfig
    from .loops.detector import LoopDetector as LoopDetector
    from .map import Map as Map
    from .recognition.follow import follow as follow
    from .recognition.matching import match as match
    from .recognition.standardise import standardise as standardise
    from .segmentation.segmenter import Segmenter as Segmenter
    from .soft.descriptor import SoftSSRVLAD as SoftSSRVLAD
    from .soft.place_loss import multi_similarity as multi_similarity
    from .soft.surrogate import SurrogateSSRVLAD as SurrogateSSRVLAD
    from .stages.explanation import Explanation as Explanation
    from .taxonomy import LabelSpace as LabelSpace

    __version__: str

_MODULES = {
    "Database": "database.database",
    "EncodeOptions": "encoding.results",
    "Explanation": "stages.explanation",
    "FrameRecord": "database.frames",
    "FrameSet": "database.frames",
    "LabelSpace": "taxonomy",
    "Map": "map",
    "LoopConfig": "loops.config",
    "LoopDetector": "loops.detector",
    "SSRVLAD": "descriptor",
    "SSRVLADConfig": "config",
    "Segmenter": "segmentation.segmenter",
    "SoftSSRVLAD": "soft.descriptor",
    "SurrogateSSRVLAD": "soft.surrogate",
    "encode_to_database": "encoding.encoder",
    "export_head": "deployment.export",
    "find_image_files": "datasets.image_files",
    "find_label_files": "datasets.label_files",
    "follow": "recognition.follow",
    "match": "recognition.matching",
    "multi_similarity": "soft.place_loss",
    "standardise": "recognition.standardise",
    "open_dataset": "datasets.layouts",
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
