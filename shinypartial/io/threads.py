"""Work on many frames at once: reading and comparing images leaves the interpreter free most of the time."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

MAX_WORKERS = 8

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results in the order of the items; the first failure cancels what has not begun."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_WORKERS)) as executor:
        try:
            yield from executor.map(function, items)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
