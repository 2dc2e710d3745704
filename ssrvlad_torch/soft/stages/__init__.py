"""The stages of the differentiable twin: each is the stage of the same name in real numbers with
gradients, and gives the same result for zeros and ones. None imports another."""
