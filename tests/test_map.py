"""Pictures in, places out, in Python."""

import numpy as np
import pytest
from drawings import SPACE
from helpers import street
from networks import PLAIN, Strided, photo
from PIL import Image
from segmenting import write_photos, write_settings

from ssrvlad_torch import SSRVLAD, Database, Localiser, Segmenter
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.segmentation.networks import runs_code


@pytest.fixture
def settings(tmp_path):
    return write_settings(tmp_path, f"labels_as: {SPACE}\n")


@pytest.fixture
def localiser(settings, tmp_path):
    return Localiser.from_pretrained(settings, tmp_path / "town")


@pytest.fixture
def folder(tmp_path):
    """Thirty photos, half of them with a pose."""
    write_photos(tmp_path / "monday", range(30), (60, 80))
    rows = [f"monday/{seed},{seed},{-seed},0.5" for seed in range(15)]
    (tmp_path / "poses.csv").write_text("\n".join(["frame,x,y,heading", *rows]))
    return tmp_path / "monday"


def test_a_picture_finds_its_place(localiser, folder, tmp_path):
    with pytest.raises(ValueError, match="town holds no frames yet"):
        localiser.locate(folder / "7.png")
    assert localiser.add(folder).encoded == len(localiser) == 30
    place = localiser.locate(folder / "7.png")
    assert place.frame == "monday/7"
    assert place.pose == (7, -7, 0.5)
    assert 0.5 < place.confidence <= 1
    assert place.estimate.accepted == 1
    assert place.estimate.wrong == pytest.approx(1 - place.confidence)
    again = Localiser.open(tmp_path / "town").locate(photo(street(22, 60, 80)))
    assert (again.frame, again.pose) == ("monday/22", None)
    assert max(place.score, again.score) <= 1
    with pytest.raises(FileNotFoundError, match=r"No such file or directory: '.*none\.png'"):
        localiser.locate(folder / "none.png")
    localiser.database.remove(["monday/7"])
    assert localiser.locate(folder / "7.png").frame != "monday/7"


def test_frames_that_are_added_while_others_are_loaded_are_found(localiser, folder, monkeypatch):
    localiser.add(folder / "1.png")
    original = Database.load

    def load(database):
        monkeypatch.setattr(Database, "load", original)
        frames = database.load()
        localiser.add(folder / "7.png")
        return frames

    monkeypatch.setattr(Database, "load", load)
    found = [localiser.locate(folder / "7.png").frame for _ in range(2)]
    assert found == ["monday/1", "monday/7"]


def test_what_cannot_be_known_has_no_place(settings, folder, tmp_path):
    localiser = Localiser.from_pretrained(settings, tmp_path / "town", preset="paper")
    localiser.add(folder / "1.png", folder / "2.png")
    assert localiser.locate(photo(np.full((60, 80), 8))) is None, "only cars"
    place = localiser.locate(folder / "1.png")
    assert place.confidence == place.estimate.accepted == 0, "two frames are nothing to go by"
    (folder.parent / "torn.jpg").write_bytes(b"torn")
    for picture, message in (
        (np.zeros((3, 4)), r"expected a list of \(H, W, 3\) uint8"),
        (Image.open(folder / "1.png").convert("RGB"), r"expected a picture as .* got Image"),
        (folder.parent / "torn.jpg", r"torn\.jpg: is no image file"),
    ):
        with pytest.raises(ValueError, match=message):
            localiser.locate(picture)


def test_another_network_is_refused_and_label_maps_are_not(localiser, folder, maps, tmp_path):
    localiser.add(folder)
    other = Segmenter(Strided(2), SPACE, PLAIN)
    with pytest.raises(ValueError, match=r"made by .*net\.yaml as it was then; the given network"):
        Localiser(other, Database.open(tmp_path / "town"))
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    drawn = Database.create(tmp_path / "drawn", head.config)
    encode_to_database(head, find_label_files([str(maps)]), drawn)
    assert Localiser(other, drawn).locate(folder / "3.png")
    with pytest.raises(ValueError, match="was not made from pictures"):
        Localiser.open(tmp_path / "drawn")


@pytest.mark.parametrize(
    ("network", "code"),
    [("net.onnx", False), ("hf:ORG/NAME", False), ("torchhub:O/R/M", True), ("nets:mine", True)],
)
def test_a_name_that_runs_code_is_told_also_through_a_file(tmp_path, network, code):
    (tmp_path / "net.yaml").write_text(f"network: {network}\n")
    assert runs_code(network) == code
    assert runs_code(str(tmp_path / "net.yaml")) == code
