"""The entry point of the command line: an error becomes one line on stderr and an exit code: 0
success, 1 a difference found by `verify`, 2 wrong use or unusable input, 3 finished with some
inputs skipped, 130 interrupted, 143 terminated. `main` imports the rest, so that Ctrl-C during an
import is handled."""

import os
import re
import select
import signal
import sys
import warnings
from typing import Any

WRONG_USE = 2
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM

_ENDS = {INTERRUPTED: "interrupted", TERMINATED: "terminated"}


def main() -> None:
    """Runs the command that ``sys.argv`` names, and exits."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed; another file would get its number and its lines
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    if sys.getfilesystemencoding() == "ascii":  # the names of files would be escapes
        again = [sys.executable, "-P", "-X", "utf8", "-m", "ssrvlad_torch", *sys.argv[1:]]
        os.execv(sys.executable, again)  # -P: no modules of the working folder
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    # of Pillow; the package raises an error
    warnings.filterwarnings("ignore", "Image size .* exceeds limit")
    try:
        code = _run(arguments, debug=len(arguments) < len(sys.argv) - 1)
        sys.stdout.flush()
    except BrokenPipeError:
        code = WRONG_USE
        if _is_unread(sys.stdout):  # the reader stopped, as in `ssrvlad query ... | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = 0
    except KeyboardInterrupt:
        code = INTERRUPTED
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else WRONG_USE
    if code in _ENDS:
        print(f"ssrvlad: {_ENDS[code]}", file=sys.stderr)
    sys.exit(code)


def _run(arguments: list[str], debug: bool) -> int:
    import typer

    from .app import app
    from .output import note

    try:
        for before, argument in zip(["ssrvlad", *arguments], arguments, strict=False):
            # as of a variable that is not set: as a path it is the current folder
            if not argument or (argument.startswith("--") and argument.endswith("=")):
                name = argument.removesuffix("=") or f"the argument after {before}"
                raise ValueError(f"{name} is empty; expected a text")
        try:
            code: int = app(arguments, standalone_mode=False)
        except SystemExit as end:
            if end.code == TERMINATED:
                raise
            if isinstance(end.__context__, OSError):  # a pipe broke, for which typer exits
                raise end.__context__ from None
            raise ValueError(f"a network or a library calls sys.exit({end.code!r})") from end
        return code
    except typer.Abort:
        return INTERRUPTED
    except typer.TyperException as error:
        note(_refusal(error))
    except (KeyboardInterrupt, GeneratorExit, SystemExit):
        raise
    except BaseException as error:  # also a panic of Lance
        if isinstance(error, BrokenPipeError) and _is_unread(sys.stdout):
            raise
        message = _sentence(error)
        if debug or message is None:
            import traceback

            traceback.print_exception(error)
        note(message or f"an error in ssrvlad itself: {error!r}")
    return WRONG_USE


def _is_unread(stream: Any) -> bool:
    """Whether a stream is a pipe that nobody reads; where that cannot be asked, it is."""
    if not hasattr(select, "poll"):
        return True
    try:
        poll = select.poll()
        poll.register(stream, 0)
        return bool(poll.poll(0))
    except (OSError, ValueError):  # a stream in memory
        return False


def _refusal(error: Any) -> str:
    """The message of wrong use, with the value that was got."""
    message = str(error.format_message()).replace("Value error, ", "").rstrip(".")
    problems: list[Any] = getattr(error.__cause__, "errors", list)()  # of pydantic
    return f"{message}, got {problems[0]['input']}" if problems else message


def _sentence(error: BaseException) -> str | None:
    """The message of an error of an input or the machine; ``None`` for an error in the code."""
    if isinstance(error, OverflowError):
        return f"a number of the command or of an input is too large: {error}"
    if isinstance(error, RecursionError):
        return f"an input is nested too deeply: {error}"
    if isinstance(error, MemoryError) or re.search("allocate memory|start new thread", str(error)):
        return f"out of memory: {error}".removesuffix(": ")
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error) if isinstance(error, ValueError | OSError | ImportError) else None
