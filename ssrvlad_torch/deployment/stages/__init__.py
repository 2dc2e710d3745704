"""The stages of `ssrvlad_torch.stages` as ONNX operators, in modules of the same names."""
