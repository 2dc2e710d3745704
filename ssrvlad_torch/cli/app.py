"""The command line: ``ssrvlad COMMAND``. Results go to stdout, notes and errors to stderr.

The module of a command defines its options and its output. It imports the rest inside the command,
so that ``--help`` needs no torch."""

from typing import Annotated

import typer

from ..config import package_version
from ..native import core
from .commands.city import city
from .commands.compare import compare
from .commands.db import db
from .commands.demo import demo
from .commands.encode import encode
from .commands.evaluate import evaluate
from .commands.export import export
from .commands.fuse import fuse
from .commands.labels import labels
from .commands.locate import locate
from .commands.loops import loops
from .commands.poses import poses
from .commands.query import query
from .commands.show import show
from .commands.verify import verify
from .options import GroupedCommand, expand

app = typer.Typer(
    name="ssrvlad", add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
)


LIMITS = (
    "Environment variables: SSRVLAD_PIXEL_LIMIT, largest number of pixels of a picture (64 "
    "million); SSRVLAD_FILE_LIMIT, largest number of bytes of a file (256 MiB)."
)


@app.callback(invoke_without_command=True, epilog=LIMITS)
def ssrvlad(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[
        bool,
        typer.Option(
            "--debug", help="Print the traceback of an error; allowed anywhere on the line."
        ),
    ] = False,
) -> None:
    """Place recognition from semantic segmentation (SSR-VLAD)."""
    del debug  # `main` reads it from the whole line
    if version:
        print(f"ssrvlad {package_version()}, {core().status}")
    elif context.invoked_subcommand is None:
        print(context.get_help())


for command in (
    *(demo, city, encode, query, locate, evaluate, loops, compare),
    *(export, fuse, verify, labels, poses, show),
):
    app.command(cls=GroupedCommand)(expand(command))
app.add_typer(db, name="db")
