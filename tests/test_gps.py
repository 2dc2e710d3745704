"""Positions of GPS on a plane in metres, and in the EXIF tags of pictures."""

import math
import os

import numpy as np
import pytest
from helpers import refuses
from PIL import ExifTags, Image
from trees import plant

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.poses import UNKNOWN, read_poses

EAST, NORTH = 303189.31, 5787193.03
"""Metres of 52.2 degrees north and 0.12 east in zone 31U."""


def test_latitudes_become_metres(tmp_path):
    pytest.importorskip("utm")
    path = tmp_path / "gps.csv"
    path.write_text("frame,latitude,longitude,course\na,52.2,0.12,90\nb,52.201,0.12,\n")
    first, second = read_poses(path).values()
    np.testing.assert_allclose(first, [EAST, NORTH, 0], atol=0.01)
    assert second.y - first.y == pytest.approx(111.2, abs=0.1)
    assert math.isnan(second.heading)
    for places in ("a,52.2,5.9\nb,52.2,6.1", "a,52.2,5.99", "a,0.005,7"):
        path.write_text(f"frame,latitude,longitude\n{places}\n")
        refuses("within 1 km of the border of a UTM zone", read_poses, path)
    path.write_text("frame,latitude,longitude\na,89,5.9\n")
    refuses("latitude out of range", read_poses, path)


def test_exif_tags_give_poses_of_some_pictures(tmp_path):
    pytest.importorskip("utm")
    folder = plant(tmp_path / "photos", "1.jpg", "2.jpg")
    tag, exif = ExifTags.GPS, Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({
        tag.GPSLatitudeRef: "N", tag.GPSLatitude: (52.0, 12.0, 0.0),
        tag.GPSLongitudeRef: "E", tag.GPSLongitude: (0.0, 7.0, 12.0),
        tag.GPSImgDirectionRef: "T", tag.GPSImgDirection: 0.0,
    })  # fmt: skip
    Image.new("RGB", (8, 6)).save(tmp_path / "photos" / "1.jpg", exif=exif)
    os.mkfifo(tmp_path / "photos" / "3.png")
    files = find_image_files([folder, str(tmp_path / "photos" / "*.png")], poses="exif")
    expected = [[EAST, NORTH, math.pi / 2], UNKNOWN, UNKNOWN]
    np.testing.assert_allclose([file.pose for file in files], expected, atol=0.01)
    with pytest.raises(ValueError, match="no image of none has a position in its EXIF"):
        find_image_files([plant(tmp_path / "none", "1.jpg")], poses="exif")
