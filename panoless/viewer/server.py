"""The viewer's server: a scene and its controls in viser, fed from folders: a running fit knows nothing of it."""

import importlib.util
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from panoless.viewer.content import (
    PICTURES,
    SHOWN,
    SPHERE_RADII,
    Moment,
    Surface,
    environment_sphere,
    moment_folders,
    picture_of_test,
    thumbnail,
)
from shinypartial.core.camera import ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.core.mesh import Mesh
from shinypartial.dataset.read import open_dataset
from shinypartial.dataset.schema import Dataset, Frame
from shinypartial.prediction.format import DESCRIPTION, read_info
from shinypartial.prediction.surface import triangles_of

FRUSTUM_SHARE = 1 / 12
"""Length of a camera in the picture, as a share of the cameras' median distance from the world's origin."""
THUMBNAIL_PX = 128
POLL_SECONDS = 2.0
RAY_COLORS = np.array([[[255, 210, 60]] * 2, [[255, 120, 40]] * 2], np.uint8)
"""Of the way from the camera, and of what was mirrored."""


@dataclass(frozen=True)
class Address:
    """Where the viewer listens."""

    host: str = "127.0.0.1"
    """Only programs of this machine reach 127.0.0.1; 0.0.0.0 is for all of the network."""
    port: int = 8080
    """The next free one is taken where this is not."""


def require_viser() -> None:
    """Raise InputError unless viser can be imported; imports nothing."""
    if importlib.util.find_spec("viser") is None:
        raise InputError(
            expected="viser, which shows fits in the browser",
            found="no module named viser",
            remedy="Install it: pip install 'panoless[viewer]'.",
        )


class Viewer:
    """One scene in the browser. What it shows is replaced as folders change."""

    def __init__(self, dataset: Dataset | None, prediction: Path, address: Address = Address()) -> None:
        """Open the server with the cameras; photographs follow in a thread, and the prediction when it is there."""
        require_viser()
        import viser

        self._dataset, self._prediction = dataset, prediction
        self._server: Any = viser.ViserServer(host=address.host, port=address.port, label="panoless", verbose=False)
        self._moment: Moment | None = None
        self._stamp = 0.0
        self._lock = threading.Lock()
        self._server.scene.set_up_direction("+z")
        self._controls()
        self._show_cameras()
        self.refresh()
        threading.Thread(target=self._show_photographs, daemon=True).start()

    @property
    def url(self) -> str:
        """Address for the browser."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def stop(self) -> None:
        """Close the server."""
        self._server.stop()

    def refresh(self) -> bool:
        """Show the prediction if it is new on disk since the last time; whether it is."""
        description = self._prediction / DESCRIPTION
        stamp = description.stat().st_mtime if description.exists() else 0.0
        if stamp <= self._stamp:
            return False
        self._stamp, folders = stamp, moment_folders(self._prediction)
        self._moments = list(folders.values())
        self._slider.max, self._slider.visible = max(len(folders) - 1, 1), len(folders) > 1
        self._slider.value = len(folders) - 1
        self.show(Moment.read(self._prediction, "end"))
        self._show_picture()
        return True

    def show_surface(self, surface: Surface, note: str) -> None:
        """A surface of a fit that goes on."""
        self._note.content = note
        self._draw_surface(surface)

    def show(self, moment: Moment) -> None:
        """Surface and environment of a moment."""
        with self._lock:
            self._moment = moment
            self._note.content = f"Moment: {moment.name}"
            if moment.surface is not None:
                self._draw_surface(moment.surface)
            self._draw_environment()

    def pick(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N 3"]:
        """Draw the way of a ray from a camera over the surface to the environment; its corners, one for a miss."""
        surface = None if self._moment is None else self._moment.surface
        corners = origin[None] if surface is None else surface.path(origin, direction, SPHERE_RADII)
        segments = np.stack([corners[:-1], corners[1:]], 1)
        colors = RAY_COLORS[np.minimum(np.arange(len(segments)), 1)]
        if len(segments):
            self._server.scene.add_line_segments("/ray", segments, colors, thickness=3, thickness_units="screen")
        else:
            self._server.scene.remove_by_name("/ray")
        return corners

    def _controls(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_share_button=False, dark_mode=True)
        self._note = gui.add_markdown("Waiting for the fit …")
        self._slider = gui.add_slider("snapshot", min=0, max=1, step=1, initial_value=0, visible=False)
        self._shown = gui.add_dropdown("environment", SHOWN)
        self._cameras_shown = gui.add_checkbox("cameras", True)
        with gui.add_folder("Ray of a pixel"):
            names = [frame.name for frame in self._frames] or ["none"]
            self._view = gui.add_dropdown("view", names)
            self._column, self._row = (gui.add_number(label, 0, min=0, step=1) for label in ("column", "row"))
            gui.add_markdown("Or click the surface: the ray comes from where you look.")
        with gui.add_folder("Test views"):
            tests = [frame.name for frame in self._tests] or ["none"]
            self._test = gui.add_dropdown("test view", tests)
            self._picture = gui.add_dropdown("picture", PICTURES, initial_value="error")
            self._image = gui.add_image(np.zeros((2, 2, 3), np.uint8))
        self._slider.on_update(lambda _: self._show_snapshot())
        self._shown.on_update(lambda _: self._draw_environment())
        self._cameras_shown.on_update(lambda _: self._toggle_cameras())
        for control in (self._view, self._column, self._row):
            control.on_update(lambda _: self._pick_pixel())
        for control in (self._test, self._picture):
            control.on_update(lambda _: self._show_picture())

    @property
    def _frames(self) -> Sequence[Frame]:
        return () if self._dataset is None else self._dataset.train

    @property
    def _tests(self) -> Sequence[Frame]:
        return () if self._dataset is None else self._dataset.test

    def _show_cameras(self) -> None:
        from scipy.spatial.transform import Rotation

        distances = [np.linalg.norm(frame.camera.position_world) for frame in self._frames]
        scale = FRUSTUM_SHARE * float(np.median(distances)) if distances else 1.0
        self._cameras: list[Any] = []
        for frame in self._frames:
            camera = frame.camera
            quaternion = Rotation.from_matrix(camera.camera_to_world[:3, :3]).as_quat()[[3, 0, 1, 2]]
            self._cameras.append(
                self._server.scene.add_camera_frustum(
                    f"/cameras/{frame.name}",
                    fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
                    aspect=camera.width / camera.height,
                    scale=scale,
                    wxyz=quaternion,
                    position=camera.position_world,
                )
            )

    def _show_photographs(self) -> None:
        for frame, camera in zip(self._frames, self._cameras, strict=True):
            camera.image = thumbnail(frame, THUMBNAIL_PX)

    def _toggle_cameras(self) -> None:
        for camera in self._cameras:
            camera.visible = self._cameras_shown.value

    def _draw_surface(self, surface: Surface) -> None:
        scene = self._server.scene
        if not len(surface.triangles):
            colors = np.rint(127.5 * (surface.normals + 1)).astype(np.uint8)
            scene.add_point_cloud("/surface", surface.vertices, colors, point_size=0.01 * surface.radius)
            return
        handle = scene.add_mesh_simple(
            "/surface", surface.vertices, surface.triangles, color=(190, 195, 205), side="double"
        )

        @handle.on_click
        def _(event: Any) -> None:
            self.pick(np.array(event.ray_origin), np.array(event.ray_direction))

    def _draw_environment(self) -> None:
        if self._moment is None:
            return
        import trimesh

        sphere, surface = environment_sphere(self._moment, self._shown.value), self._moment.surface
        center, radius = (np.zeros(3), 1.0) if surface is None else (surface.center, surface.radius)
        vertices = center + SPHERE_RADII * radius * sphere.vertices
        mesh = trimesh.Trimesh(vertices, sphere.triangles, vertex_colors=sphere.colors, process=False)
        self._server.scene.add_mesh_trimesh("/environment", mesh)

    def _show_snapshot(self) -> None:
        if self._moment is None:
            return
        folder = self._moments[min(int(self._slider.value), len(self._moments) - 1)]
        self.show(Moment.read(folder, "end" if folder == self._prediction else f"{int(folder.name)} steps"))

    def _pick_pixel(self) -> None:
        for frame in self._frames:
            if frame.name == self._view.value:
                row = min(int(self._row.value), frame.camera.height - 1)
                column = min(int(self._column.value), frame.camera.width - 1)
                self.pick(frame.camera.position_world, ray_directions_world(frame.camera)[row, column])

    def _show_picture(self) -> None:
        for frame in self._tests:
            if frame.name == self._test.value and self._stamp:
                self._image.image = picture_of_test(self._prediction, frame, self._picture.value)


def open_prediction(folder: Path, address: Address = Address()) -> Viewer:
    """The viewer of a prediction folder, with cameras and photographs where its dataset is still where it was.

    Raises InputError when the folder is no prediction.
    """
    info = read_info(folder)
    try:
        dataset = open_dataset(Path(info.dataset))
    except InputError:
        dataset = None
    return Viewer(dataset, folder, address)


def follow_run(viewer: Viewer, run: Path) -> None:
    """Show what a run saves and, when it is there, its prediction; for ever, in a thread of its own."""
    from panoless.reconstruct.state import CHECKPOINT

    def follow() -> None:
        seen = 0.0
        while True:
            checkpoint = run / CHECKPOINT
            stamp = checkpoint.stat().st_mtime if checkpoint.exists() else 0.0
            if not viewer.refresh() and stamp > seen:
                viewer.show_surface(*surface_of_run(run))
            seen = max(seen, stamp)
            time.sleep(POLL_SECONDS)

    threading.Thread(target=follow, daemon=True).start()


def surface_of_run(run: Path) -> tuple[Surface, str]:
    """The surface of the last checkpoint of a run, and what to say of it."""
    from panoless.reconstruct.state import load_state

    state = load_state(run)
    assert state is not None, "there is a checkpoint"
    mesh = state.geometry.mesh(state.frame)
    normals = np.stack([mesh.columns[name] for name in ("nx", "ny", "nz")], 1).astype(np.float64)
    polygons = [] if mesh.faces is None else [tuple(face) for face in mesh.faces.tolist()]
    vertices = mesh.vertices.astype(np.float64)
    surface = Surface(vertices, normals, triangles_of(Mesh(vertices, normals, polygons)))
    return surface, f"{state.geometry.kind}, {state.iteration} steps"


def serve(viewer: Viewer) -> None:
    """Say where the viewer is and stay until Ctrl-C."""
    print(f"Viewer: {viewer.url} (Ctrl-C ends it)")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        viewer.stop()
