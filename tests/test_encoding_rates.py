"""The halves of encoding are those of the whole; how long they take is no test's business."""

from helpers import write_street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.describer import Describer, Item, read
from ssrvlad_torch.encoding.encoder import encode

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


def some_files(folder):
    for number in range(20):
        write_street(folder / "a" / f"{number}.png", number)
    return find_label_files([str(folder / "a")])


def test_reading_and_then_describing_is_encoding(tmp_path):
    files = some_files(tmp_path)
    halves = Describer(HEAD).describe(read(HEAD.label_space, [Item(file) for file in files]))
    for half, frame in zip(halves, encode(HEAD, files, 0), strict=True):
        assert repr(half.record) == repr(frame.record)
        assert (half.descriptor == frame.descriptor.numpy()).all()
