"""`ssrvlad show`."""

import numpy as np
from drawings import SPACE
from helpers import street
from PIL import Image


def test_show_takes_an_image(network, ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    frame, picture = tmp_path / "photos" / "1.png", tmp_path / "out.png"
    assert ssrvlad("show", frame, "-o", picture, "--segmenter", network)[0] == 0
    shown = Image.open(picture)
    labels = frame.with_name("labels.png")
    Image.fromarray(street(1, 60, 80)).save(labels)
    assert ssrvlad("show", labels, "-o", tmp_path / "map.png", "--labels-as", SPACE)[0] == 0
    assert shown.width == 1.5 * Image.open(tmp_path / "map.png").width, (
        "the photograph is beside it"
    )
    sky = np.array([128, 128, 128])
    assert (np.abs(np.asarray(shown)[..., :3] - sky) < 2).all(-1).any()
    assert len([*(tmp_path / "cache").rglob("*.png")]) == 1
    assert "--labels-as" in ssrvlad("show", frame, "-o", picture)[2][0]
