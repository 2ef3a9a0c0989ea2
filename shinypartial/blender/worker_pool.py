"""A pool of rendering processes: the one place that starts, replaces and ends them; never imports bpy itself."""

import contextlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import shinypartial
from shinypartial.blender.messages import BackdropOf, Ready, Refused, Start, receive, send
from shinypartial.blender.render import RenderedView
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.io.system import usable_cores
from shinypartial.scene import SceneSpec

WORKER = "shinypartial.blender.worker"
ATTEMPTS = 2
LOG = "log.txt"


@dataclass(frozen=True)
class PoolPlan:
    """How many processes render at a time, with how many threads each, and how many frames one renders in its life."""

    workers: int
    threads: int
    frames_per_worker: int = 100

    def __post_init__(self) -> None:
        if min(self.workers, self.threads, self.frames_per_worker) < 1:
            raise ValueError(f"a pool of workers needs at least one of each, not {self}")


def plan_pool(cores: int | None = None) -> PoolPlan:
    """One process for every two cores, at most four.

    What a frame costs besides its samples (preparing the scene, passing files) runs on one thread, so several
    processes should keep many cores busier than one; each holds the scene in memory. On two cores one was faster.
    """
    if cores is None:
        cores = usable_cores()
    workers = min(max(cores // 2, 1), 4)
    return PoolPlan(workers, max(cores // workers, 1))


class PoolClosed(Exception):
    """A view was requested when the pool was closed, or it was closed before the view was there."""


class _WorkerDied(Exception):
    """A process ended without an answer."""


@dataclass(eq=False)
class _Worker:
    process: "subprocess.Popen[bytes]"
    folder: Path
    rendered: int = field(default=0)

    def request(self, message: Any) -> Any:
        """Send a message and wait for the answer to it; raises _WorkerDied, or the InputError that it answers with."""
        assert self.process.stdin
        assert self.process.stdout
        try:
            send(self.process.stdin, message)
            answer = receive(self.process.stdout)
        except (EOFError, OSError, ValueError):  # The last where `end` has closed the pipes.
            self.process.kill()
            raise _WorkerDied(_how_it_ended(self.process.wait(), self.folder / LOG)) from None
        if isinstance(answer, Refused):
            raise answer.error()
        return answer

    def end(self) -> None:
        """Kill it, if it still runs, and remove what it left."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe
            with contextlib.suppress(OSError):  # What could not be sent is still in the buffer.
                pipe.close()
        shutil.rmtree(self.folder, ignore_errors=True)


class WorkerPool:
    """Processes that render views of one scene; `render` may be called from several threads at once."""

    def __init__(self, spec: SceneSpec, plan: PoolPlan, folder: Path) -> None:
        self.spec, self.plan, self.folder = spec, plan, folder
        self.device = ""
        self.started = 0
        self._lock = threading.Lock()
        self._closed = False
        self._live: set[_Worker] = set()
        # A seat holds an idle worker or nobody yet. There is one until the first worker has stated its device.
        self._seats: queue.Queue[_Worker | None] = queue.Queue()
        self._seats.put(None)

    def render(self, camera: Camera, name: str) -> RenderedView:
        """Render one view of the object; see `_ask`."""
        view: RenderedView = self._ask(camera, name)
        return view

    def render_backdrop(self, camera: Camera, name: str) -> Float[np.ndarray, "H W 3"]:
        """Radiance of what stands around the object in one view; see `_ask`."""
        backdrop: np.ndarray = self._ask(BackdropOf(camera), name)
        return backdrop

    def _ask(self, message: Camera | BackdropOf, name: str) -> Any:
        """A process's answer; one that dies is replaced, once for each question.

        Raises InputError, which names the view, when the second process dies as well, or when Blender refuses;
        PoolClosed when the pool is closed.
        """
        died: list[str] = []
        while len(died) < ATTEMPTS:
            try:
                return self._ask_once(message)
            except _WorkerDied as death:
                died.append(str(death))
        raise InputError(
            expected=f"Blender to render {name}",
            found=f"that its process ended {ATTEMPTS} times: {'; '.join(dict.fromkeys(died))}",
            remedy="Free some memory, then run the same command again: it continues. If it ends there again, "
            "try fewer samples or a lower --resolution.",
        )

    def close(self) -> None:
        """End every process at once; a thread that waits for a view gets PoolClosed."""
        with self._lock:
            self._closed = True
            live, self._live = self._live, set()
        for worker in live:
            worker.process.kill()
        for worker in live:
            worker.end()

    def _ask_once(self, message: Any) -> Any:
        worker = self._seats.get()
        try:
            if worker is None:
                worker = self._start()
            answer = worker.request(message)
            worker.rendered += 1
            if worker.rendered >= self.plan.frames_per_worker:
                self._dismiss(worker)
                worker = None
            return answer
        except BaseException as error:
            if worker is not None:
                self._dismiss(worker)
                worker = None
            if self._closed and isinstance(error, _WorkerDied):
                raise PoolClosed from None
            raise
        finally:
            self._seats.put(worker)

    def _start(self) -> _Worker:
        with self._lock:
            if self._closed:
                raise PoolClosed
            self.started += 1
            folder = self.folder / f"worker-{self.started}"
            folder.mkdir()
            worker = _Worker(_spawn(folder), folder)
            self._live.add(worker)
        try:
            ready: Ready = worker.request(Start(self.spec, folder, self.plan.threads))
        except BaseException:
            self._dismiss(worker)
            if self._closed:
                raise PoolClosed from None
            raise
        with self._lock:
            first, self.device = not self.device, ready.device
        if first and ready.device == "CPU":  # A GPU is shared by no two processes.
            for _ in range(self.plan.workers - 1):
                self._seats.put(None)
        return worker

    def _dismiss(self, worker: _Worker) -> None:
        with self._lock:
            self._live.discard(worker)
        worker.end()


@contextlib.contextmanager
def open_pool(spec: SceneSpec, plan: PoolPlan | None = None) -> Iterator[WorkerPool]:
    """A pool whose processes and temporary folder end with the block."""
    with tempfile.TemporaryDirectory(prefix="shinypartial-", ignore_cleanup_errors=True) as folder:
        pool = WorkerPool(spec, plan or plan_pool(), Path(folder))
        try:
            yield pool
        finally:
            pool.close()


def _spawn(folder: Path) -> "subprocess.Popen[bytes]":
    """A fresh Python, never a fork: Blender doesn't survive one. Its temporary files go to its own folder."""
    source = str(Path(shinypartial.__file__).resolve().parents[1])
    paths = [source, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder)}
    with (folder / LOG).open("wb") as log:
        command = [sys.executable, "-m", WORKER]
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, bufsize=-1
        )


def _how_it_ended(status: int, log: Path) -> str:
    """By what signal or with what status, and the last line that it wrote."""
    if status < 0:
        try:
            how = f"by {signal.Signals(-status).name}"
        except ValueError:
            how = f"by signal {-status}"
    else:
        how = f"with status {status}"
    with contextlib.suppress(OSError):
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        how += f" ({last})" if last else ""
    return how
