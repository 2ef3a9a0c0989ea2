"""A time limit of a fit: what improves a state ends there, what completes it does not.

Every checkpoint (see `panoless.journal`) of a block that is `improving` a state looks at the clock. Past the limit it
leaves that block, and the state before it is the result. Nothing that was computed after that is remembered, so the
same command without a limit goes on from the last whole checkpoint.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


class OutOfTimeError(Exception):
    """Past the limit; `improving` ends with it."""


@dataclass
class _Clock:
    end: float
    improving: int = 0


_clock: ContextVar[_Clock | None] = ContextVar("clock", default=None)


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """A limit (s) within this block; None: no limit."""
    token = _clock.set(None if seconds is None else _Clock(time.monotonic() + seconds))
    try:
        yield
    finally:
        _clock.reset(token)


@contextmanager
def improving() -> Iterator[None]:
    """A block that the time limit may end at a checkpoint."""
    clock = _clock.get()
    if clock is None:
        yield
        return
    clock.improving += 1
    try:
        yield
    except OutOfTimeError:
        pass
    finally:
        clock.improving -= 1


def is_past_limit() -> bool:
    """Whether the limit has ended, or should end, what improves a state."""
    clock = _clock.get()
    return clock is not None and time.monotonic() > clock.end


def check_time() -> None:
    """At a checkpoint: raise OutOfTimeError past the limit where something is improved."""
    clock = _clock.get()
    if clock is not None and clock.improving and is_past_limit():
        raise OutOfTimeError
