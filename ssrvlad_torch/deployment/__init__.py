"""The head as an ONNX graph."""
