"""What kernels share: memory that is used again, and threads that join in."""

import gc
from threading import Event

import numpy as np
import pytest
import torch

from panoless.kernels.cpu import workers
from panoless.kernels.cpu.workers import run_shared
from panoless.splats.kernels.cpu.buffers import take


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "thread_count", lambda: 2)


def test_memory_is_not_handed_out_while_a_view_or_a_tensor_shows_it():
    shape = (977, 31)
    held = [take(shape) for _ in range(3)]
    held = [held[0][5:, 2], torch.from_numpy(held[1]), held[2].reshape(-1)[::7]]
    for number, each in enumerate(held):
        each[:] = number
    for _ in range(20):
        take(shape)[:] = -1
    for number, each in enumerate(held):
        assert bool((torch.as_tensor(each) == number).all())


def test_memory_is_used_again_once_nobody_sees_it():
    gc.collect()
    first = take((1013, 29))
    address = first.ctypes.data
    del first
    assert take((1013, 29)).ctypes.data == address


def test_memory_is_aligned_to_vectors():
    assert all(take((count,)).ctypes.data % 64 == 0 for count in (1, 17, 4099))


def test_all_claims_are_done_and_waited_for(two_threads):
    done = np.zeros(1000, dtype=np.int64)
    claims = iter(range(len(done)))

    def kernel(_, target):
        for claim in claims:
            target[claim] += 1

    run_shared(kernel, done)
    assert (done == 1).all()


def test_a_thread_that_has_yet_to_wake_is_not_waited_for(two_threads):
    """The helpers are busy; a kernel ends without them, and they don't begin it afterwards."""
    release, calls = Event(), []
    pool = workers._pool()
    pool.grow(1)
    for _ in range(pool._threads):
        pool.tasks.put(workers._Task(lambda _: release.wait(20), (None,)))
    run_shared(lambda _: calls.append(1))
    assert calls == [1]
    release.set()
    run_shared(lambda _: None)
    assert calls == [1]


def test_an_error_of_a_helper_is_raised(two_threads):
    joined = Event()
    main = []

    def kernel(_):
        if not main:
            main.append(1)
            assert joined.wait(20)
            return
        joined.set()
        raise ArithmeticError("of the helper")

    with pytest.raises(ArithmeticError, match="of the helper"):
        run_shared(kernel)
