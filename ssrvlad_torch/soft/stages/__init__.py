"""The stages of the differentiable twin: each does what the stage of its name does, in real
numbers with gradients, and on zeros and ones it gives the same. None imports another."""
