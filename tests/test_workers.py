"""Work in threads: order, memory and errors."""

import pytest

from ssrvlad_torch.datasets.workers import in_order


def squared(number):
    return number * number


@pytest.mark.parametrize("count", [0, 2, 50])
@pytest.mark.parametrize("threads", [0, 1, 3])
def test_results_come_in_the_order_of_the_items(threads, count):
    assert list(in_order(squared, range(count), threads, 5)) == [n * n for n in range(count)]


def test_items_are_numbers_as_they_are_needed():
    numbers = []
    items = (numbers.append(number) or number for number in range(1000))
    results = in_order(squared, items, 2, 6)
    assert next(results) == 0
    assert len(numbers) <= 6
    results.close()


def test_errors_come_after_earlier_results_and_keep_their_type():

    def items():
        yield from range(7)
        raise KeyboardInterrupt

    results = in_order(squared, items(), 2, 4)
    assert [next(results) for _ in range(7)] == [n * n for n in range(7)]
    with pytest.raises(KeyboardInterrupt):
        next(results)

    def fail(_item):
        raise ZeroDivisionError("nothing to share")

    with pytest.raises(ZeroDivisionError, match="nothing to share"):
        list(in_order(fail, range(3), 2, 4))
