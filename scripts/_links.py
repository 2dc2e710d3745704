"""Links of the pages that lead out of docs/, to the repository's files, as MkDocs sees them."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_LINK = re.compile(r"\]\((\.\./[^)#]+)(#[^)]*)?\)")


def on_page_markdown(text: str, page: Any, config: Any, **_: Any) -> str:
    """A link to a file outside docs/ leads to the repository; one to no file is an error."""
    folder = PurePosixPath("docs") / PurePosixPath(page.file.src_uri).parent

    def outside(link: re.Match[str]) -> str:
        target = (ROOT / folder / link[1]).resolve()
        if target.is_relative_to(ROOT / "docs"):
            return link[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri} links to {link[1]}, which is not there")
        where = f"{config['repo_url'].rstrip('/')}/blob/main/" if config["repo_url"] else "#"
        return f"]({where}{target.relative_to(ROOT) if config['repo_url'] else ''})"

    return _LINK.sub(outside, text)
