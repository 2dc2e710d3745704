"""Draws docs/figures/stages-PRESET.png, a frame of the synthetic city as `ssrvlad show` does, and
demo.png.

python scripts/pages/how_it_works.py
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from _markdown import save

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.cli.demo import run_demo
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity

SPACE = "cityscapes-trainids"
FRAMES = 100
"""Frames of each drive of the demo, as in `ssrvlad demo`."""

FRAME = 4
"""The one that is drawn."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("docs/figures"))
    options = parser.parse_args()
    *_, frame = SyntheticCity().traverse(FRAME + 1)
    for preset in PRESETS:
        view = SSRVLAD.from_preset(preset, labels_as=SPACE).explain(frame.labels[None])
        save(view.show(), options.output / f"stages-{preset}.png")
    with TemporaryDirectory() as folder:
        _, shown = run_demo(Path(folder) / "demo", FRAMES, 0, lambda _: None)
        shutil.copy(shown, options.output / "demo.png")


if __name__ == "__main__":
    main()
