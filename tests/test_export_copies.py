"""Numbers of the package that export/ types again."""

import re
from pathlib import Path

import pytest
from ssrvlad_place import model
from test_fusion import TRUST

ROOT = Path(__file__).parents[1]
COPIES = {
    "cpp/map.hpp": r"add\(path, .*, model\.(\w+), .*, ([\d.]+)\)",
    "cpp/loops.hpp": r'"([\w-]+)",\s+model_\.\w+,\s+\{SSRVLAD_\w+, \{.*?\}, ([\d.]+)\}',
    "web/database.js": r'title: "([\w-]+)", trust: ([\d.]+)',
}


@pytest.mark.parametrize("name", COPIES)
def test_channels_are_trusted_as_in_the_package(name):
    found = re.findall(COPIES[name], (ROOT / "export" / name).read_text())
    assert {each.replace("descriptor", "ssr-vlad"): float(trust) for each, trust in found} == TRUST
    assert model.TRUST == TRUST


def test_the_page_is_written_for_the_interface_of_the_headers():
    header = (ROOT / "ssrvlad_torch" / "native" / "ssrvlad.h").read_text()
    page = (ROOT / "export" / "web" / "core.js").read_text()
    (expected,) = re.findall(r"#define SSRVLAD_INTERFACE (\d+)", header)
    assert re.findall(r"const INTERFACE = (\d+);", page) == [expected]
