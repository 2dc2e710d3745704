"""Not run with hloc itself: the tests call it as hloc's `extract_features` does.

A global descriptor for hloc. Copy this file to ``hloc/extractors/ssrvlad.py`` and name it:

    conf = {
        "output": "global-feats-ssrvlad",
        "model": {"name": "ssrvlad", "file": "/maps/place.onnx"},
        "preprocessing": {"resize_max": 1024},
    }
    extract_features.main(conf, images, outputs)

The file is one of `ssrvlad fuse`. It needs onnxruntime beside what hloc needs.
"""

import numpy as np
import onnxruntime
import torch

from ..utils.base_model import BaseModel


class SSRVLAD(BaseModel):
    """Images ``(B, 3, H, W)`` RGB from 0 to 1 -> ``global_descriptor`` ``(B, 480)`` float32."""

    default_conf = {"file": "place.onnx"}  # noqa: RUF012
    required_inputs = ["image"]  # noqa: RUF012

    def _init(self, conf):
        self.session = onnxruntime.InferenceSession(
            conf["file"],
            providers=["CPUExecutionProvider"],  # others may compute the head wrong
        )
        names = [each.name for each in self.session.get_inputs()]
        if names != ["image"]:
            raise ValueError(
                f"{conf['file']}: expected a file of `ssrvlad fuse`, got input {names}"
            )

    def _forward(self, data):
        image = data["image"]
        pixels = (image * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
        (descriptor,) = self.session.run(["descriptor"], {"image": pixels.cpu().numpy()})
        if not np.isfinite(descriptor).all():
            raise ValueError("the image is too wide, or has too many keypoints, for such a file")
        return {"global_descriptor": torch.from_numpy(descriptor).to(image.device)}
