"""The head as one ONNX file."""

from .export import export_head
from .metadata import Metadata

__all__ = ["Metadata", "export_head"]
