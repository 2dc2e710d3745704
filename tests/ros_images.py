"""Images as ROS sends them, and what the node's core says of them."""

from types import SimpleNamespace

from helpers import street
from loop_streams import SEEDS
from ssrvlad_ros import live_loops

from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.taxonomy import label_space

CAMVID = [(each.id, each.name) for each in label_space("camvid-11").classes]
CONFIG = LoopConfig(exclude=5, sweep=False)
SECOND = 10**9


def picture(pixels, encoding="mono8", padding=0, big=0):
    """A ``sensor_msgs/Image``, of a label map or of a picture."""
    dtype = live_loops.DTYPES.get(encoding, "u1")
    stored = pixels.astype(dtype.replace("u", ">u" if big else "<u"))
    rows = [row.tobytes() + b"\x63" * padding for row in stored]
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=big,
        step=stored[0].nbytes + padding,
        data=b"".join(rows),
    )


def updates(core, seeds=SEEDS, start=0):
    """What a core says of a drive, a frame a second."""
    return [
        core.update(picture(street(seed)), number * SECOND, (number, -1.0, 0.5))
        for number, seed in enumerate(seeds, start)
    ]


def seen(core, seeds=SEEDS, start=0):
    """The results of `updates`."""
    return [update.result for update in updates(core, seeds, start)]
