"""What the detector of `loop_closure` is made of."""
