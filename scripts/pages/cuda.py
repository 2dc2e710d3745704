#!/usr/bin/env python3
"""Prints the table of docs/benchmark.md on CUDA: needs a GPU, and label maps of CamVid.

python scripts/pages/cuda.py ../shared/data/camvid
"""

import sys
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from _markdown import head_row, row, span
from _timing import heads, threads, time_in_turn
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.config import PRESETS

SIZES, BATCHES, REPETITIONS = ((120, 160), (512, 512), (1024, 1024)), (1, 64), 5


def main() -> None:
    files = sorted(Path(sys.argv[1]).glob("**/*.png"))
    print(torch.cuda.get_device_name(), torch.__version__, torch.get_num_threads(), "threads")
    names = ("CUDA", "native core", "native core, one thread", "torch, CPU")
    print(*head_row("preset", "size", "batch", *names, "largest difference"), sep="\n")
    for preset, (height, width), count in product(PRESETS, SIZES, BATCHES):
        config = SSRVLADConfig.from_preset(preset, labels_as="camvid-11")
        pictures = (Image.open(files[n % len(files)]) for n in range(count))
        maps = [np.asarray(each.resize((width, height), Image.NEAREST)) for each in pictures]
        labels, on_cpu = torch.from_numpy(np.stack(maps)), heads(config)
        there, given = SSRVLAD(config).to("cuda"), labels.to("cuda")
        ways = {
            "CUDA": lambda there=there, given=given: there(given).cpu(),
            "native core": partial(on_cpu["native core"], labels),
            "native core, one thread": partial(with_one, on_cpu["native core"], labels),
            "torch, CPU": partial(on_cpu["torch"], labels),
        }
        taken = time_in_turn(ways, REPETITIONS).values()
        times = ({k: v / count for k, v in each.milliseconds.items()} for each in taken)
        difference = float((there(given).cpu() - on_cpu["native core"](labels)).abs().max())
        cells = (span(each, 2) for each in times)
        print(
            row(preset, f"{height} x {width}", str(count), *cells, f"{difference:.0e}"), flush=True
        )


def with_one(head: SSRVLAD, labels: Tensor) -> Tensor:
    with threads(1):
        return head(labels)


if __name__ == "__main__":
    main()
