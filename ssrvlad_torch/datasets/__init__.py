"""Data sets: label maps on disk, poses, and the synthetic city."""
