"""`ssrvlad show` and `ssrvlad demo`: the commands that draw."""

from __future__ import annotations

from PIL import Image


def test_show_writes_a_picture(ssrvlad, maps, tmp_path):
    picture = tmp_path / "frame.png"
    code, out, _ = ssrvlad("show", maps / "001.png", "-o", picture, "--labels-as", "camvid-11")
    assert (code, out.strip()) == (0, str(picture))
    assert Image.open(picture).size[0] > 1000


def test_demo(ssrvlad, tmp_path):
    code, out, err = ssrvlad("demo", "--out", tmp_path / "demo", "--frames", 8)
    assert (code, err) == (0, [])
    for metric in ("RecallRate@1", "AUC-PR", "Recall@100%Precision"):
        assert metric in out
    assert Image.open(tmp_path / "demo" / "demo.png").size[0] > 300
    code, _, (line,) = ssrvlad("demo", "--out", tmp_path / "demo", "--frames", 8)
    assert code == 2
    assert "empty" in line
