"""Ground truth, and metrics of place recognition."""
