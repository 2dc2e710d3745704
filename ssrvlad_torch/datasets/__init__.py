"""Data sets: frames on disk, poses, layouts of published data sets, and the synthetic city."""
