"""Not run with hloc itself: the tests call it as hloc's `extract_features` does.

A global descriptor for hloc. Copy this file to ``hloc/extractors/ssrvlad.py``, the folder
`ssrvlad_place` beside it, and name it:

    conf = {
        "output": "global-feats-ssrvlad",
        "model": {"name": "ssrvlad", "file": "/maps/place.onnx"},
        "preprocessing": {"resize_max": 1024},
    }
    extract_features.main(conf, images, outputs)

The file is one of `ssrvlad fuse`. It needs onnxruntime beside what hloc needs.
"""

from pathlib import Path

import numpy as np
import torch

from ..utils.base_model import BaseModel
from .ssrvlad_place.model import Model


class SSRVLAD(BaseModel):
    """Images ``(B, 3, H, W)`` RGB from 0 to 1 -> ``global_descriptor`` ``(B, 480)`` float32."""

    default_conf = {"file": "place.onnx"}  # noqa: RUF012
    required_inputs = ["image"]  # noqa: RUF012

    def _init(self, conf):
        self.model = Model(Path(conf["file"]))
        if self.model.input.name != "image":
            raise ValueError(
                f"{conf['file']}: expected a file of `ssrvlad fuse`, got input "
                f"{self.model.input.name}"
            )

    def _forward(self, data):
        image = data["image"]
        pixels = (image * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
        found = np.stack([self.model.see_array(each).descriptor for each in pixels.cpu().numpy()])
        return {"global_descriptor": torch.from_numpy(found).to(image.device)}
