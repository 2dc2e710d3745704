"""Place-recognition methods behind one protocol: SSR-VLAD, its rivals, and the trivial ones."""

from .protocol import METHODS, Frame, Method, class_of, make

__all__ = ["METHODS", "Frame", "Method", "class_of", "make"]
