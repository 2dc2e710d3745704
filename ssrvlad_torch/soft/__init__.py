"""The differentiable twin and the place loss."""
