"""Data sets: frames on disk, poses, the layouts in which data sets are published, and the city."""
