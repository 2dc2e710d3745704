"""``torch.hub.load(REPOSITORY, "ssrvlad")``: the head, or pictures to places with a network."""

from __future__ import annotations

from torch import nn

dependencies = ["torch", "numpy", "PIL", "pyarrow", "yaml", "kornia"]


def ssrvlad(
    segmenter: str | None = None, labels_as: str = "auto", preset: str = "default"
) -> nn.Module:
    """The head, from label maps or class scores to descriptors; or, with a network, all of it.

    Args:
        segmenter: name of a network, as of `ssrvlad_torch.Segmenter.load`; without, the head alone.
        labels_as: label space; ``"auto"`` is that of the network's class names, of the head alone
            ``cityscapes-trainids``.
        preset: ``"default"`` or ``"paper"``.

    Returns:
        a module of ``(B, H, W)`` label maps, or with a network of ``(B, H, W, 3)`` uint8 pictures;
        it gives ``(B, 480)`` descriptors.
    """
    from ssrvlad_torch import SSRVLAD, Segmenter

    if segmenter is None:
        space = "cityscapes-trainids" if labels_as == "auto" else labels_as
        return SSRVLAD.from_preset(preset, labels_as=space)
    network = Segmenter.load(segmenter, labels_as)
    head = SSRVLAD.from_preset(preset, labels_as=network.label_space)
    return nn.Sequential(network.labels, head)
