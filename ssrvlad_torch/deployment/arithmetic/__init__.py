"""The aggregation harmonics as a graph of arithmetic only: no bit operators, no loops, no shapes
that depend on pixel values. The modules have the names of those in `ssrvlad_torch.stages`.

Whole numbers are float32 below 2 ** 24, so they are exact in any order of operations. A quotient of
whole numbers is computed as (numerator + 1/2) * (1 / denominator), rounded down: the rounding error
is far less than half the inverse of the denominator.
"""
