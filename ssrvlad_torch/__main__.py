"""``python -m ssrvlad_torch`` is ``ssrvlad``."""

from .cli import main

main()
