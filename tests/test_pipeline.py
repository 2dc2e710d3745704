"""Work in worker processes: in order, bounded, and honest about what went wrong."""

import os
import signal
import time

import pytest

from ssrvlad_torch.encoding.workers import in_order


def squared(number):
    return number * number


@pytest.mark.parametrize("workers", [0, 1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 50])
def test_results_come_in_the_order_of_the_items(workers, count):
    assert list(in_order(squared, range(count), workers)) == [n * n for n in range(count)]


def test_the_work_is_done_elsewhere():
    assert os.getpid() not in in_order(lambda _: os.getpid(), range(4), 2)
    assert set(in_order(lambda _: os.getpid(), range(4), 1)) == {os.getpid()}


def test_items_are_taken_as_they_are_needed():
    taken = []
    items = (taken.append(number) or number for number in range(1000))
    results = in_order(squared, items, 2)
    assert next(results) == 0
    assert len(taken) < 20


def test_an_error_of_the_items_comes_after_what_was_before_it():
    def items():
        yield from range(7)
        raise KeyboardInterrupt

    results, seen = in_order(squared, items(), 2), []
    with pytest.raises(KeyboardInterrupt):
        seen.extend(results) or [seen.append(result) for result in results]
    assert seen == [n * n for n in range(7)]


def test_an_error_of_the_work_has_its_own_kind():
    def fail(_):
        raise ZeroDivisionError("nothing to share")

    with pytest.raises(ZeroDivisionError, match="nothing to share"):
        list(in_order(fail, range(3), 2))


def test_a_killed_worker_is_named():
    def die(number):
        if number == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with pytest.raises(ChildProcessError, match="a worker process was killed"):
        list(in_order(die, range(20), 2))


def test_workers_begin_as_they_are_told_and_pass_over_ctrl_c():
    begun = []

    def state(_):
        return begun == [1], signal.getsignal(signal.SIGINT) == signal.SIG_IGN

    assert set(in_order(state, range(4), 2, begin=lambda: begun.append(1))) == {(True, True)}
    assert begun == []


def test_workers_end_with_the_results(tmp_path):
    results = in_order(lambda _: os.getpid(), iter(range(100)), 2)
    worker = next(results)
    del results
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("the worker goes on")
