"""The stages of the method in the order of DESIGN: each a file with one job, none imports another."""
