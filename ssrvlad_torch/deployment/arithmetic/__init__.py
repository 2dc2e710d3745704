"""The aggregation harmonics as a graph of arithmetic only: no bits, no loops, no shapes that depend
on what is in the picture. One module a stage, by the names of `ssrvlad_torch.stages`.

Whole numbers are float32 below 2 ** 24, where they are exact in any order of operations. Nothing is
divided that has to be exact: a whole number plus a half, times the inverse of another, is rounded
down, and what rounding is off by is far from a half of the inverse.
"""
