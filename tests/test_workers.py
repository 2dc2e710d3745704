"""Work in threads and processes: order, memory, errors, and the end of worker processes."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ssrvlad_torch.encoding.workers import in_order


def squared(number):
    return number * number


def own_process(_item):
    return os.getpid()


def fail(_item):
    raise ZeroDivisionError("nothing to share")


def die_at_five(number):
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def noisy(number):
    print("a library that prints")
    return number


def slow(number):
    time.sleep(0.2)
    return os.getpid() if number < 2 else number


@pytest.mark.parametrize("count", [0, 2, 50])
@pytest.mark.parametrize("workers", [(0, 0), (1, 0), (2, 0), (0, 1), (1, 2)])
def test_results_come_in_the_order_of_the_items(workers, count):
    assert list(in_order(squared, range(count), *workers)) == [n * n for n in range(count)]


def test_threads_and_processes_share_the_work_with_a_thread_of_torch_each():
    import torch

    before = torch.get_num_threads()
    done = set(in_order(where, range(40), 2, 1))
    assert {process == os.getpid() for process, _, _ in done} == {True, False}
    assert len({thread for process, thread, _ in done if process == os.getpid()}) > 1
    assert {threads for _, _, threads in done} == {1}
    assert threading.get_ident() not in {thread for _, thread, _ in done}
    assert torch.get_num_threads() == before


def where(_item):
    import torch  # slow, and only this function needs it

    time.sleep(0.2)
    return os.getpid(), threading.get_ident(), torch.get_num_threads()


def test_items_are_taken_as_they_are_needed():
    taken = []
    items = (taken.append(number) or number for number in range(1000))
    results = in_order(squared, items, 1, 1)
    assert next(results) == 0
    assert len(taken) < 20


def test_an_error_of_the_items_comes_after_earlier_results():
    def items():
        yield from range(7)
        raise KeyboardInterrupt

    results = in_order(squared, items(), 1, 1)
    assert [next(results) for _ in range(7)] == [n * n for n in range(7)]
    with pytest.raises(KeyboardInterrupt):
        next(results)


@pytest.mark.parametrize("workers", [(2, 0), (0, 2)])
def test_an_error_of_the_work_keeps_its_type(workers):
    with pytest.raises(ZeroDivisionError, match="nothing to share"):
        list(in_order(fail, range(3), *workers))


def test_a_killed_worker_is_an_error():
    with pytest.raises(ChildProcessError, match="a worker process was killed"):
        list(in_order(die_at_five, range(20), 0, 2))


def test_output_of_libraries_does_not_mix_with_results():
    assert list(in_order(noisy, range(4), 0, 2)) == [0, 1, 2, 3]


def test_workers_end_when_results_are_closed():
    results = in_order(own_process, iter(range(100)), 0, 2)
    worker = next(results)
    results.close()
    assert is_gone(worker)


PARENT = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, sys.argv[1])
from test_workers import slow
from ssrvlad_torch.encoding.workers import in_order
for result in in_order(slow, range(1000), 0, 2):
    print(result, flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(number):
    """They do not hold its pipes open either."""
    command = [sys.executable, "-c", PARENT, str(Path(__file__).parent)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe) as parent:
        workers = {int(parent.stdout.readline()) for _ in range(2)}
        parent.send_signal(number)
        parent.communicate(timeout=30)
    assert all(map(is_gone, workers))


def is_gone(process):
    """Whether a process ends within some seconds."""
    for _ in range(100):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False
