"""Work in threads: in order, few items at a time, and no more after a failure."""

import os
from collections.abc import Iterator

import pytest

from shinypartial.io.threads import MAX_WORKERS, in_threads


def test_items_are_taken_as_threads_become_free() -> None:
    """However many there are, no more wait than there are threads, and one."""
    taken = []

    def items() -> Iterator[int]:
        for item in range(1, 101):
            taken.append(item)
            yield item

    ahead = 0
    for count, result in enumerate(in_threads(lambda item: 2 * item, items()), 1):
        assert result == 2 * count
        ahead = max(ahead, len(taken) - count)
    assert count == 100
    assert ahead <= min(os.cpu_count() or 1, MAX_WORKERS)


def test_a_failure_ends_the_work() -> None:
    done = []

    def work(item: int) -> None:
        if item == 3:
            raise ValueError("no more")
        done.append(item)

    with pytest.raises(ValueError, match="no more"):
        list(in_threads(work, range(1000)))
    assert len(done) < 20
