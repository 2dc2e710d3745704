"""The entry point of the command line: an error becomes one line on stderr and an exit code.

Exit codes: 0 success, 1 a file that is not what `verify` wants, 2 wrong use or an input that
nothing can be done with, 3 finished with some inputs skipped, 130 interrupted.

Everything is imported inside `main`, so that Ctrl-C during an import is an interruption like any
other.
"""

from __future__ import annotations

import os
import sys

WRONG_USE = 2
INTERRUPTED = 130


def main() -> None:
    """Runs the command that ``sys.argv`` names, and exits."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    try:
        code = _run(arguments, debug=len(arguments) < len(sys.argv) - 1)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has enough, as in `ssrvlad query ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("ssrvlad: interrupted", file=sys.stderr)
    sys.exit(code)


def _run(arguments: list[str], debug: bool) -> int:
    import typer

    from .app import app
    from .output import note

    try:
        code: int = app(arguments, standalone_mode=False)
        return code
    except SystemExit:  # what typer makes of a broken pipe
        raise BrokenPipeError from None
    except typer.Abort:
        return INTERRUPTED
    except typer.TyperException as error:
        message = error.format_message()
    except (ValueError, OSError, ImportError) as error:
        if debug:
            import traceback

            traceback.print_exc()
        message = str(error)
    note(message)
    return WRONG_USE
