"""Hooks of MkDocs: pages of export/ become part of the site, links to other files outside docs/
become the paths of the files, formulas become pictures, the page of commands gets their help."""

from __future__ import annotations

import posixpath
import re
import subprocess
import sys
from base64 import b64encode
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
EXPORT = ("export/README.md", "export/online.md", "export/ros2/README.md")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")


_FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(\S[^$\n]*?)\$", re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """The files of docs/ and the pages of export/."""
    from mkdocs.structure.files import File

    for uri in EXPORT:
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / uri)))
    return files


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """The page with links that lead from page to page, and without links to other files.

    Raises:
        FileNotFoundError: the file of a link does not exist.
    """
    uri = page.file.src_uri
    folder = (ROOT if uri in EXPORT else DOCS) / posixpath.dirname(uri)

    def inside(link: re.Match[str]) -> str:
        target = (folder / link[2]).resolve()
        if not target.exists():
            raise FileNotFoundError(f"{uri} links to {link[2]}, which does not exist")
        path = target.relative_to(ROOT).as_posix()
        if target.is_relative_to(DOCS) or path in EXPORT:
            place = path.removeprefix("docs/")
            return f"[{link[1]}]({posixpath.relpath(place, posixpath.dirname(uri))}{link[3] or ''})"
        return f"`{path}`" if link[1].strip("`") in path else f"{link[1]} (`{path}`)"

    if uri == "concepts/equations.md":
        text = _FORMULA.sub(_drawn, text)
    if uri == "reference/commands.md":
        text += "".join(_help())
    return _LINK.sub(inside, text)


def _drawn(formula: re.Match[str]) -> str:
    """A formula in TeX as a picture: on its own lines, or in a line."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.mathtext import math_to_image

    tex, picture = " ".join((formula[1] or formula[2]).split()), BytesIO()
    if formula[1]:
        tex = tex.replace(r"\frac", r"\dfrac")
    depth = math_to_image(f"${tex}$", picture, FontProperties(size=12), format="svg")
    source = b64encode(picture.getvalue()).decode()
    style = "display: block; margin: auto" if formula[1] else f"vertical-align: -{depth}pt"
    return f'<img alt="{tex}" style="{style}" src="data:image/svg+xml;base64,{source}">'


def _help() -> Iterator[str]:
    """The help of each command of the table."""
    page = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    for name in dict.fromkeys(re.findall(r"^\| `ssrvlad ((?:db )?[a-z]+)", page, re.MULTILINE)):
        command = [Path(sys.executable).with_name("ssrvlad"), *name.split(), "--help"]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        yield f"\n## ssrvlad {name}\n\n```\n{told.strip()}\n```\n"
