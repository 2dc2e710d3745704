"""The halves of encoding are those of the whole; how long they take is no test's business."""

from _encoding_rates import encoding_rates
from helpers import write_street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import Encoded, describe_only, encode, read_only

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


def some_files(folder):
    for number in range(40):
        write_street(folder / "a" / f"{number}.png", number)
    return find_label_files([str(folder / "a")])


def test_every_way_is_timed_as_often(tmp_path):
    timings = encoding_rates(HEAD, some_files(tmp_path), workers=2, repetitions=2)
    assert list(timings) == ["decode", "encode", "all"]
    for timing in timings.values():
        assert len(timing.seconds) == 2
        assert min(timing.seconds) > 0


def test_reading_and_then_describing_is_encoding(tmp_path):
    files = some_files(tmp_path)
    halves = describe_only(HEAD, read_only(HEAD, files))
    whole = [frame for frame in encode(HEAD, files, 0) if isinstance(frame, Encoded)]
    assert [repr(half.record) for half in halves] == [repr(frame.record) for frame in whole]
    for half, frame in zip(halves, whole, strict=True):
        assert (half.descriptor == frame.descriptor.numpy()).all()
