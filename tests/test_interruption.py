"""Signals that wait for the work in hand: none is lost, whenever it comes."""

import signal
import threading

import pytest

from ssrvlad_torch.encoding.interruption import deferred_interruption

ENDS = [(signal.SIGINT, KeyboardInterrupt, ()), (signal.SIGTERM, SystemExit, (143,))]


def handlers():
    return signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """Whatever runs the tests may have told them to pass over Ctrl-C."""
    before = handlers()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGTERM, before[1])


@pytest.mark.parametrize(("number", "error", "arguments"), ENDS)
def test_a_signal_waits_until_it_is_asked_for(number, error, arguments):
    before, done = handlers(), []
    with pytest.raises(error) as end, deferred_interruption() as check:
        check()
        signal.raise_signal(number)
        done.append("the work in hand")
        check()
        done.append("more")
    assert done == ["the work in hand"]
    assert end.value.args == arguments
    assert handlers() == before


@pytest.mark.parametrize(("number", "error", "arguments"), ENDS)
def test_a_signal_that_is_never_asked_for_comes_at_the_end(number, error, arguments):
    """As one does that comes while the last part is written."""
    before = handlers()
    with pytest.raises(error) as end, deferred_interruption():
        signal.raise_signal(number)
    assert end.value.args == arguments
    assert handlers() == before


def test_a_second_signal_acts_at_once():
    done = []
    with pytest.raises(KeyboardInterrupt), deferred_interruption():
        signal.raise_signal(signal.SIGINT)
        done.append("the first waits")
        signal.raise_signal(signal.SIGINT)
        done.append("the second does not")
    assert done == ["the first waits"]


def test_an_error_of_the_work_goes_before_a_signal():
    before = handlers()
    with pytest.raises(ZeroDivisionError), deferred_interruption():
        signal.raise_signal(signal.SIGINT)
        raise ZeroDivisionError
    assert handlers() == before


def test_a_signal_that_was_passed_over_still_is():
    """A shell tells what it runs in the background to pass over Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_interruption() as check:
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        signal.raise_signal(signal.SIGINT)
        check()
    with pytest.raises(SystemExit), deferred_interruption():
        signal.raise_signal(signal.SIGTERM)


def test_a_thread_defers_nothing():
    before, seen = handlers(), []

    def work():
        with deferred_interruption() as check:
            seen.append(handlers())
            check()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
