"""Ctrl-C and termination wait for the work in hand, once."""

import os
import signal
import threading

import pytest

from ssrvlad_torch.interruption import deferred_interruption


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_signal_waits_until_it_is_asked_for(number, kind):
    before = signal.getsignal(number)
    done = []
    with pytest.raises(kind) as raised, deferred_interruption() as check:
        check()
        os.kill(os.getpid(), number)
        done.append("the work in hand")
        check()
        done.append("more")
    assert done == ["the work in hand"]
    assert signal.getsignal(number) == before
    if kind is SystemExit:
        assert raised.value.code == 143


def test_a_second_signal_acts_at_once():
    with pytest.raises(KeyboardInterrupt), deferred_interruption():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("it went on")


def test_handlers_are_as_they_were_after_an_error():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(ValueError, match="x"), deferred_interruption():
        raise ValueError("x")
    assert signal.getsignal(signal.SIGTERM) == before


def test_in_another_thread_nothing_is_deferred():
    outcome = []

    def body():
        with deferred_interruption() as check:
            check()
            outcome.append("done")

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert outcome == ["done"]
