"""The stages of the method: one file and one job each, and none imports another."""
