"""Networks that were opened before: their identity, as long as their files stay as they are."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..config import package_version
from ..datasets.names import absolute
from ..files import parse_json, path_within, read_yaml, replacing

YAML = (".yaml", ".yml")
_FILE = "networks.json"


def state_of(name: str) -> str:
    """A text that changes with the files of a network, an ONNX file or a YAML file that names one:
    with the names, sizes and times of all files beside them. Empty for other networks."""
    path = Path(name)
    paths = [path]
    try:
        if path.suffix.lower() in YAML:
            document = read_yaml(path)
            paths += [path_within(path.parent, document["network"])]
            with suppress(ValueError, KeyError):  # it may be the name of a label space
                paths += [path_within(path.parent, document["labels_as"])]
        if not any(path.suffix.lower() == ".onnx" and path.is_file() for path in paths):
            return ""
        folders = sorted({path.parent for path in paths if path.is_file()})
        entries = sorted(entry for folder in folders for entry in folder.iterdir())
        stats = [(str(entry), entry.stat()) for entry in entries if entry.is_file()]
    except (ValueError, OSError, KeyError, TypeError):
        return ""
    state = [(file, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for file, s in stats]
    return hashlib.sha256(repr([package_version(), state]).encode()).hexdigest()


def known_key(name: str, cache: Path) -> str:
    """The key of the segmenter of a network whose files are as they were when it was remembered,
    without opening it; empty for others."""
    state, key = _entries(cache).get(absolute(Path(name)), ("", ""))
    return str(key) if state and state == state_of(name) else ""


def remember(name: str, state: str, key: str, cache: Path) -> None:
    """Stores the key of a segmenter, and the state of its files before it was opened."""
    content = {**_entries(cache), name: [state, key]}
    with suppress(OSError):  # it is asked again the next time
        cache.mkdir(parents=True, exist_ok=True)
        with replacing(cache / _FILE) as file:
            file.write_text(json.dumps(content))


def _entries(cache: Path) -> dict[str, Any]:
    try:
        entries: dict[str, Any] = parse_json((cache / _FILE).read_text("utf-8"), _FILE)
    except (ValueError, OSError):
        return {}
    return entries
