"""Place-recognition methods behind one protocol: SSR-VLAD, published ones and trivial ones."""

from .protocol import METHODS, Method, make

__all__ = ["METHODS", "Method", "make"]
