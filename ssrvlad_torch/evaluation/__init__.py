"""How good a set of candidates is: ground truth and metrics."""
