"""A hook of MkDocs: replaces links to files outside docs/ by the paths of the files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
_LINK = re.compile(r"\[([^\]]*)\]\((\.\./[^)#]+)\)")


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """The page without links to files outside docs/, which are not part of the site.

    Raises:
        FileNotFoundError: the file of such a link does not exist.
    """

    def outside(link: re.Match[str]) -> str:
        target = (DOCS / page.file.src_uri).parent.joinpath(link[2]).resolve()
        if target.is_relative_to(DOCS):
            return link[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri} links to {link[2]}, which does not exist")
        path = target.relative_to(DOCS.parent).as_posix()
        return f"`{path}`" if link[1] in path else f"{link[1]} (`{path}`)"

    return _LINK.sub(outside, text)
