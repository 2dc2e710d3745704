"""Runs docs/tutorial.ipynb and stores the outputs of its cells.

python scripts/pages/tutorial.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorial.ipynb"


def main() -> None:
    """Runs the notebook in place."""
    nbformat.write(executed(), NOTEBOOK)


def executed() -> Any:
    """The notebook with new outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=300, record_timing=False).execute()
    notebook.metadata.pop("language_info")  # it has the version of Python
    return notebook


if __name__ == "__main__":
    main()
