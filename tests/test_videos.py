"""Frames of videos, which PyAV wrote."""

import struct
from fractions import Fraction

import numpy as np
import pytest
from helpers import refuses, street
from networks import photo, write_graph

from ssrvlad_torch import Database
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.datasets.videos import video_files

av = pytest.importorskip("av", reason="needs the extra video")

STEADY = range(0, 4000, 40)
UNEVEN = [0, 33, 67, 100, 250, 400, 401, 700, 1000, 1033, 1066, 1100]
"""Milliseconds."""

H264 = {"codec": "libx264", "b_frames": 2}
OPEN = {**H264, "options": {"x264-params": "open-gop=1:keyint=10:min-keyint=10:scenecut=0"}}
"""Groups of pictures whose first ones in the order of showing need the group before."""
REFRESH = {"codec": "libx264", "options": {"x264-params": "intra-refresh=1:keyint=10"}}
"""Key frames after which a decoder still needs some frames from before."""


def picture(number, height=120, width=160):
    """Red above, and a gray on the left that tells the number."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2] = 20 * (number % 10) + 20
    pixels[: height // 4] = 200, 0, 0
    return pixels


def number_in(pixels):
    return round((pixels[80, 20].mean() - 20) / 20)


def write_video(
    path, times, codec="mpeg4", b_frames=0, rate=1000, created="", draw=picture, options=None
):
    """A video whose frames are shown at times in units of ``1 / rate`` seconds."""
    with av.open(str(path), "w") as container:
        if created:
            container.metadata["creation_time"] = created
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width, _ = draw(0).shape
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, rate)
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = 10, b_frames
        for number, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(draw(number), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts", "mov"])
def test_frames_have_the_names_and_stamps_of_their_times(tmp_path, suffix):
    path = write_video(tmp_path / f"a.{suffix}", UNEVEN, **(H264 if suffix != "mov" else {}))
    files = video_files(path)
    assert [file.name for file in files] == [f"{1000 * time:010d}" for time in UNEVEN]
    assert [file.stamp for file in files] == [time / 1000 for time in UNEVEN]
    assert files[0].folder == str(path), "not the folder of its extracted pictures"
    assert [number_in(read_image(file)) for file in files] == [n % 10 for n in range(12)]


def write_grainy(path, times, rng, **kind):
    """A video of noise, in which a decoder that conceals damage guesses wrong."""
    grain = rng.integers(0, 40, (120, 160, 3), np.uint8)
    draw = lambda n: picture(n) // 2 + np.roll(grain, 7 * n, 1)  # noqa: E731
    return write_video(path, times, draw=draw, **kind)


@pytest.mark.parametrize(
    "kind", [{}, H264, OPEN, REFRESH], ids=["mpeg4", "closed", "open", "refresh"]
)
@pytest.mark.parametrize("suffix", ["avi", "mkv", "mp4", "ts"])
def test_a_frame_is_the_same_whatever_was_read_before(tmp_path, suffix, kind):
    """Also in AVI, which has no times of presentation: H.264 gives its frames in another order."""
    files = video_files(write_video(tmp_path / f"a.{suffix}", range(40), rate=25, **kind))
    assert [file.name for file in files] == [f"{40_000 * n:010d}" for n in range(40)]
    forward = [read_image(file) for file in files]
    assert [number_in(pixels) for pixels in forward] == [n % 10 for n in range(40)]
    for file, pixels in zip(reversed(files), reversed(forward), strict=True):
        np.testing.assert_array_equal(read_image(file), pixels)


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), lambda pixels: pixels),
        ((-1, 0, 0, -1), lambda pixels: pixels[::-1, ::-1]),
        ((0, 1, -1, 0), lambda pixels: np.rot90(pixels, -1)),
        ((0, -1, 1, 0), np.rot90),
        ((-1, 0, 0, 1), lambda pixels: pixels[:, ::-1]),
        ((1, 0, 0, -1), lambda pixels: pixels[::-1]),
        ((0, 1, 1, 0), lambda pixels: pixels.transpose(1, 0, 2)),
        ((0, -1, -1, 0), lambda pixels: pixels[::-1, ::-1].transpose(1, 0, 2)),
    ],
)
def test_a_video_is_turned_and_mirrored_as_its_matrix_says(tmp_path, matrix, shown):
    path = write_video(tmp_path / "a.mp4", [0, 40])
    content = bytearray(path.read_bytes())
    place = content.find(b"tkhd") + 44
    right_x, right_y, down_x, down_y = (number << 16 for number in matrix)
    content[place : place + 36] = struct.pack(
        ">9i", right_x, right_y, 0, down_x, down_y, 0, 0, 0, 1 << 30
    )
    path.write_bytes(content)
    pixels, expected = read_image(video_files(path)[0]), shown(picture(0))
    assert pixels.shape == expected.shape
    assert np.abs(pixels.astype(int) - expected).mean() < 3


def test_the_rate_does_not_change_the_ids(tmp_path):
    path = str(write_video(tmp_path / "a.mp4", UNEVEN, **H264))
    whole = [file.frame for file in find_image_files([path])]
    for fps, milliseconds in ((1, [0, 1000]), (10, [0, 100, 250, 400, 700, 1000, 1100])):
        chosen = [file.frame for file in find_image_files([path], fps=fps)]
        assert chosen == [f"a/{1000 * time:010d}" for time in milliseconds]
        assert set(chosen) <= set(whole)
    assert len(find_image_files([path], fps=1e6)) == len(whole)
    assert [file.name for file in find_image_files([path], fps=1, every=2)] == ["0000000000"]


def test_a_truncated_video_gives_the_frames_before_its_end_and_a_note(tmp_path):
    path = write_video(tmp_path / "a.mkv", STEADY, **H264)
    content = path.read_bytes()
    notes = []
    assert len(find_image_files([str(path)], note=notes.append)) == 100 and not notes
    path.write_bytes(content[: len(content) * 6 // 10])
    files = find_image_files([str(path)], note=notes.append)
    assert 40 < len(files) < 70
    assert [number_in(read_image(file)) for file in files] == [n % 10 for n in range(len(files))]
    assert len(notes) == 1 and f"{path} lasts 4.0 s, and its last frame is at 2." in notes[0]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts"])
def test_no_frame_shows_what_a_decoder_made_up(tmp_path, name):
    """It conceals damage, and frames that depend on concealed ones decode without an error."""
    rng = np.random.default_rng(0)
    path = write_grainy(tmp_path / name, STEADY, rng, **H264)
    files = video_files(path)
    expected = [read_image(file).astype(int) for file in files]
    content = bytearray(path.read_bytes())
    for place in rng.integers(len(content) // 5, len(content) * 4 // 5, 3):
        content[place : place + 20] = rng.bytes(20)
    path.write_bytes(content)
    right = set()
    for place, (file, pixels) in enumerate(zip(video_files(path), expected, strict=True)):
        try:
            decoded = read_image(file)
        except ValueError as error:
            assert str(error) == "the frame does not decode: the video is damaged"
        else:
            assert np.abs(decoded - pixels).mean() < 8, file.name
            right.add(place)
    assert 30 < len(right) < len(files) and {0, 1, 98, 99} <= right


@pytest.mark.parametrize("content", [b"", b"no video", b"\0" * 1000, b"#EXTM3U\n/etc/passwd\n"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    refuses(r"a\.mp4 is not a readable video: ", find_image_files, [path])
    write_video(tmp_path / "b.mp4", range(3))
    unreadable, *frames = find_image_files([path, tmp_path / "b.mp4"])
    assert len(frames) == 3, "one file does not spoil the others"
    refuses(r"a\.mp4 is not a readable video: ", read_image, unreadable)


def test_a_gps_track_gives_poses_between_its_points(tmp_path):
    """If the video says when it was recorded: that time is added to the stamps."""
    pytest.importorskip("utm")
    created = "2026-05-01T10:00:00Z"
    path = str(write_video(tmp_path / "a.mp4", [0, 500, 1000, 1500, 6000, 9000], created=created))
    points = "".join(
        f'<trkpt lat="{48 + n / 1000}" lon="8.5"><time>2026-05-01T10:00:0{n}Z</time></trkpt>'
        for n in (0, 1, 2, 8)
    )
    track = tmp_path / "a.gpx"
    track.write_text(f'<gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    files = find_image_files([path], poses=str(track))
    assert [file.stamp for file in files[:2]] == [1777629600.0, 1777629600.5]
    north = [file.pose.y - files[0].pose.y for file in files]
    assert north[:4] == pytest.approx([0, 55.6, 111.2, 166.8], abs=0.1)
    assert all(np.isnan(north[4:])), "6 s lie between two points; nothing lies after the last one"
    silent = str(write_video(tmp_path / "b.mp4", [0, 500]))
    with pytest.raises(ValueError, match=r"no pose is near in time to the 2 frames, .* or a video"):
        find_image_files([silent], poses=str(track))


def test_commands_take_videos(ssrvlad, tmp_path):
    photos = [photo(street(seed, 60, 80)) for seed in range(5)]
    drive = write_video(
        tmp_path / "drive.mp4", range(0, 1000, 100), draw=lambda number: photos[number // 2]
    )
    town = tmp_path / "town.ssrdb"
    network = ("--segmenter", write_graph(tmp_path / "seg.onnx"), "--labels-as", "camvid-11")
    network = (*network, "--segmenter-cache", tmp_path / "cache")
    code, _, err = ssrvlad(
        "encode", drive, "-o", town, *network, "--fps", 5, "--channel", "ssr-vlad"
    )
    assert code == 0 and all("assumed" in line for line in err)
    assert Database.open(town).load().frames == tuple(f"drive/{200_000 * n:010d}" for n in range(5))
    assert ssrvlad("encode", drive, "-o", town, *network)[1].startswith(
        f"{town}: 5 frames encoded (0 of them empty), 5 already there"
    )
    code, out, _ = ssrvlad("locate", drive, "--in", town, "--start", 4, "--every", 9)
    assert (code, out.split(" (")[0]) == (0, "drive/0000400000: drive/0000400000")
    code, out, _ = ssrvlad("loops", drive, *network, "--exclude", 1)
    assert code == 0 and "10 frames" in [line.partition(":")[0] for line in out.splitlines()]
    code, _, err = ssrvlad("encode", drive, "-o", town, "--labels-as", "camvid-11")
    assert code == 2 and "holds images and no label maps" in err[0]
