"""Rendering processes: same pictures, replaced in time, replaced when they die, gone when their parent is."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shinypartial.blender import worker_pool
from shinypartial.blender.render import RenderedView, open_renderer
from shinypartial.blender.worker_pool import PoolClosed, PoolPlan, WorkerPool, open_pool, plan_pool
from shinypartial.core.camera import Camera
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import plan_cameras
from shinypartial.scene import SceneSpec
from tests.support.tiny_scene import tiny_scene, write_recipe

pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[3]
LONG_ENOUGH_S = 60.0
ONE = PoolPlan(workers=1, threads=1)
posix_only = pytest.mark.skipif(os.name != "posix", reason="SIGKILL is a POSIX signal.")


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    return tiny_scene(tmp_path_factory.mktemp("recipe"), train=4, test=1)


@pytest.fixture(scope="module")
def cameras(spec: SceneSpec) -> tuple[Camera, ...]:
    return plan_cameras(spec.camera, spec.render.resolution).train


@pytest.fixture(scope="module")
def expected(spec: SceneSpec, cameras: tuple[Camera, ...]) -> list[RenderedView]:
    """The views as this process renders them."""
    with open_renderer(spec) as renderer:
        return [renderer.render(camera) for camera in cameras]


def assert_same(view: RenderedView, expected: RenderedView) -> None:
    """Cycles is not reproducible to the bit across processes: relative differences up to 6e-5 were measured."""
    np.testing.assert_allclose(view.radiance, expected.radiance, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(view.alpha, expected.alpha, atol=1e-6)
    np.testing.assert_allclose(view.normals_world, expected.normals_world, atol=1e-4)
    np.testing.assert_allclose(view.depth, expected.depth, rtol=1e-4)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_ENOUGH_S
    while not condition():
        assert time.monotonic() < deadline, "It did not happen in time."
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """Whether the process exists and is no zombie that waits for its parent's attention."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def only_worker(pool: WorkerPool) -> "worker_pool._Worker":
    (worker,) = pool._live
    return worker


def test_views_are_those_of_one_process_and_workers_are_replaced_in_time(
    spec: SceneSpec, cameras: tuple[Camera, ...], expected: list[RenderedView]
) -> None:
    with open_pool(spec, PoolPlan(workers=1, threads=1, frames_per_worker=2)) as pool:
        views = [pool.render(camera, "a view") for camera in cameras]
        assert pool.started == 2
        assert not pool._live, "The second has rendered its two frames as well."
        folder = pool.folder
        assert list(folder.iterdir()) == []
    for view, reference in zip(views, expected, strict=True):
        assert_same(view, reference)
    assert not folder.exists()


@posix_only
def test_a_killed_worker_is_replaced_and_its_view_rendered(
    spec: SceneSpec, cameras: tuple[Camera, ...], expected: list[RenderedView]
) -> None:
    with open_pool(spec, ONE) as pool:
        pool.render(cameras[0], "the first view")
        only_worker(pool).process.send_signal(signal.SIGKILL)
        assert_same(pool.render(cameras[1], "the second view"), expected[1])
        assert pool.started == 2


def test_a_view_that_kills_two_workers_is_named(
    spec: SceneSpec, cameras: tuple[Camera, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_pool, "WORKER", "shinypartial.no_such_module")
    with open_pool(spec, ONE) as pool:
        with pytest.raises(InputError, match=r"train/r_007.*2 times: with status 1 \(.*no_such_module") as caught:
            pool.render(cameras[0], "train/r_007")
        assert pool.started == 2
        assert "run the same command again" in caught.value.remedy


@posix_only
def test_how_a_worker_ended_is_stated(
    spec: SceneSpec, cameras: tuple[Camera, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    request = worker_pool._Worker.request

    def killed_first(worker, message):
        worker.process.send_signal(signal.SIGKILL)
        worker.process.wait()
        return request(worker, message)

    monkeypatch.setattr(worker_pool._Worker, "request", killed_first)
    with open_pool(spec, ONE) as pool, pytest.raises(InputError, match="by SIGKILL"):
        pool.render(cameras[0], "a view")


def test_blender_s_refusal_arrives_as_it_was_raised(spec: SceneSpec, cameras: tuple[Camera, ...]) -> None:
    with open_pool(spec, ONE) as pool:
        pool.render(cameras[0], "a view")
        folder = only_worker(pool).folder
        shutil.rmtree(folder)
        folder.write_text("Not a folder.")
        with pytest.raises(InputError, match="Not a directory"):
            pool.render(cameras[1], "a view")
        assert not pool._live, "One that has refused is not used again."


def test_a_closed_pool_renders_nothing_and_leaves_nothing(spec: SceneSpec, cameras: tuple[Camera, ...]) -> None:
    with open_pool(spec, ONE) as pool:
        pool.render(cameras[0], "a view")
        pid, folder = only_worker(pool).process.pid, pool.folder
        pool.close()
        with pytest.raises(PoolClosed):
            pool.render(cameras[1], "a view")
    assert not is_running(pid)
    assert not folder.exists()


PARENT = """
import sys
from shinypartial.blender.worker_pool import PoolPlan, open_pool
from shinypartial.core.trajectory import plan_cameras
from shinypartial.scene import load_scene
spec = load_scene(sys.argv[1])
camera = plan_cameras(spec.camera, spec.render.resolution).train[0]
with open_pool(spec, PoolPlan(1, 1)) as pool:
    pool._seats.put(pool._start() if pool._seats.get() is None else None)
    (worker,) = pool._live
    print(worker.process.pid, pool.folder, flush=True)
    pool.render(camera, "a view that takes long")
"""


@posix_only
@pytest.mark.skipif(not Path("/proc").exists(), reason="Processes are looked up in /proc.")
def test_workers_notice_the_death_of_their_parent_in_the_middle_of_a_frame(tmp_path: Path) -> None:
    scene = write_recipe(tmp_path, samples=65536, resolution=1024)
    process = subprocess.Popen([sys.executable, "-c", PARENT, str(scene)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    pid, folder = process.stdout.readline().split()
    time.sleep(1)
    assert is_running(int(pid))
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    wait_until(lambda: not is_running(int(pid)) and not Path(folder).exists())


def test_the_plan_divides_the_cores() -> None:
    for cores in range(1, 200):
        plan = plan_pool(cores)
        assert plan.workers * plan.threads <= max(cores, 1)
        assert plan.workers * (plan.threads + 1) > cores, "No whole thread a worker is left over."


@pytest.mark.parametrize("plan", [(0, 1), (1, 0), (-1, 1)])
def test_an_empty_pool_is_refused(plan: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="at least one"):
        PoolPlan(*plan)
