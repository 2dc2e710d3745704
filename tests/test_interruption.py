"""Deferred signals: none is lost, whenever it arrives."""

import signal
import threading

import pytest

from ssrvlad_torch.encoding.interruption import deferred_interruption

ENDS = [(signal.SIGINT, KeyboardInterrupt, ()), (signal.SIGTERM, SystemExit, (143,))]


def handlers():
    return signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)


@pytest.fixture(autouse=True)
def handlers_of_a_terminal():
    """The program that runs the tests may ignore Ctrl-C."""
    before = handlers()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGTERM, before[1])


@pytest.mark.parametrize(("number", "error", "arguments"), ENDS)
def test_a_signal_waits_until_check_is_called(number, error, arguments):
    before, done = handlers(), []
    with pytest.raises(error) as end, deferred_interruption() as check:
        check()
        signal.raise_signal(number)
        done.append("current work")
        check()
        done.append("more")
    assert done == ["current work"]
    assert end.value.args == arguments
    assert handlers() == before


@pytest.mark.parametrize(("number", "error", "arguments"), ENDS)
def test_a_signal_without_a_check_takes_effect_at_the_end(number, error, arguments):
    before = handlers()
    with pytest.raises(error) as end, deferred_interruption():
        signal.raise_signal(number)
    assert end.value.args == arguments
    assert handlers() == before


def test_a_second_signal_takes_effect_at_once():
    done = []
    with pytest.raises(KeyboardInterrupt), deferred_interruption():
        signal.raise_signal(signal.SIGINT)
        done.append("the first waits")
        signal.raise_signal(signal.SIGINT)
        done.append("the second does not")
    assert done == ["the first waits"]


def test_an_error_takes_precedence_over_a_signal():
    before = handlers()
    with pytest.raises(ZeroDivisionError), deferred_interruption():
        signal.raise_signal(signal.SIGINT)
        raise ZeroDivisionError
    assert handlers() == before


def test_an_ignored_signal_stays_ignored():
    """A shell starts background jobs with Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_interruption() as check:
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        signal.raise_signal(signal.SIGINT)
        check()
    with pytest.raises(SystemExit), deferred_interruption():
        signal.raise_signal(signal.SIGTERM)


def test_a_thread_defers_nothing():
    before, found = handlers(), []

    def work():
        with deferred_interruption() as check:
            found.append(handlers())
            check()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [before]
