"""``python -m ssrvlad_torch`` is ``ssrvlad``."""

from .cli.main import main

main()
