"""Work on many frames at once: reading and comparing images leaves the interpreter free most of the time."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

MAX_WORKERS = 8

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Results in the order of the items, of which no more are taken at a time than there are threads, and one; the
    first failure cancels what has not begun.
    """
    workers = min(os.cpu_count() or 1, MAX_WORKERS)
    begun: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers) as executor:
        try:
            for item in items:
                begun.append(executor.submit(function, item))
                if len(begun) > workers:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
