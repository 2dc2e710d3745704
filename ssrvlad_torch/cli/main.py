"""The command line: ``ssrvlad COMMAND``. Results go to stdout, errors are one line on stderr.

Exit codes: 0 success, 1 a file that is not what `verify` wants, 2 wrong use or an input that
nothing can be done with, 3 finished with some inputs refused, 130 interrupted.
"""

from __future__ import annotations

import sys

import typer

from .commands.bench import bench
from .commands.city import city
from .commands.compare import compare
from .commands.db import db
from .commands.demo import demo
from .commands.encode import encode
from .commands.evaluate import evaluate
from .commands.export import export
from .commands.fuse import fuse
from .commands.loops import loops
from .commands.query import query
from .commands.show import show
from .commands.verify import verify
from .commands.vocabulary import vocabulary
from .output import note

WRONG_USE = 2
INTERRUPTED = 130

app = typer.Typer(
    name="ssrvlad",
    help="Place recognition from semantic segmentation (SSR-VLAD).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    demo,
    city,
    encode,
    query,
    evaluate,
    loops,
    compare,
    vocabulary,
    export,
    fuse,
    verify,
    show,
    bench,
):
    app.command()(command)
app.add_typer(db, name="db")


def main() -> None:
    """Entry point: runs the command line; an error becomes one line and an exit code."""
    try:
        code = app(standalone_mode=False)
    except typer.TyperException as error:
        code = _complain(error.format_message())
    except (ValueError, OSError, ImportError) as error:
        code = _complain(str(error))
    except (typer.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer makes an exit code of Ctrl-C, too
        note("interrupted")
    sys.exit(code)


def _complain(message: str) -> int:
    note(message)
    return WRONG_USE
