"""Ctrl-C and termination that wait until the current work is saved."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def deferred_interruption() -> Iterator[Callable[[], None]]:
    """Defers SIGINT and SIGTERM until the body calls the yielded function or ends.

    That function raises KeyboardInterrupt after a SIGINT, and SystemExit with code 143 after a
    SIGTERM. A second signal takes effect at once. A signal that the process ignores, like SIGINT in
    a background job of a shell, stays ignored. Outside the main thread, where Python handles no
    signals, nothing is deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    earlier = {n: handler for n, handler in handlers.items() if handler != signal.SIG_IGN}

    def restore() -> None:
        for number, handler in earlier.items():
            signal.signal(number, handler)

    def defer(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        restore()

    def check() -> None:
        if signal.SIGINT in received:
            raise KeyboardInterrupt
        if received:
            raise SystemExit(128 + received[0])

    try:
        for number in earlier:
            signal.signal(number, defer)
        yield check
    finally:
        restore()
    check()
