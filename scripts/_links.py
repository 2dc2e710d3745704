"""Hooks of MkDocs: pages of export/ become part of the site, and links to other files outside docs/
become the paths of the files."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
EXPORT = ("export/README.md", "export/online.md", "export/ros2/README.md")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")


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

    return _LINK.sub(inside, text)
