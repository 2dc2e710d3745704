"""A hook of MkDocs: links that lead out of docs/ become the path of the repository's file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
_LINK = re.compile(r"\[([^\]]*)\]\((\.\./[^)#]+)\)")


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """The site has docs/ alone; a reader of it finds other files by their path.

    Raises:
        FileNotFoundError: a link leads to no file.
    """

    def outside(link: re.Match[str]) -> str:
        target = (DOCS / page.file.src_uri).parent.joinpath(link[2]).resolve()
        if target.is_relative_to(DOCS):
            return link[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri} links to {link[2]}, which is not there")
        path = target.relative_to(DOCS.parent).as_posix()
        return f"`{path}`" if link[1] in path else f"{link[1]} (`{path}`)"

    return _LINK.sub(outside, text)
