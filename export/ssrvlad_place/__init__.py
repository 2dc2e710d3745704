"""What the programs of this folder share. It needs numpy and onnxruntime."""
