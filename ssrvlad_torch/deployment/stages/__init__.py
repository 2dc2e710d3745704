"""The stages of the method as ONNX operators: each does what the stage of its name does."""
