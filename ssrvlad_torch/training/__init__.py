"""What a training loop needs beside `SSRVLAD(..., surrogate=True)`: a loss on descriptors."""

from .multi_similarity import multi_similarity

__all__ = ["multi_similarity"]
