"""Draw the pictures of docs/reference/conventions.md from the functions that define the conventions.

Run: python docs/examples/draw_conventions.py [FOLDER]   (default: docs/images)
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from shinypartial.core.camera import Camera, look_at, opencv_to_opengl, ray_directions_world
from shinypartial.core.conventions import FACE_AXES, FACES
from shinypartial.core.sphere import cube_directions, directions_to_latlong, latlong_directions

AXIS_COLORS = ("#d62728", "#2ca02c", "#1f77b4")
AXIS_NAMES = ("X", "Y", "Z")
SIGNED_AXES = {f"{sign}{name}": i for i, name in enumerate(AXIS_NAMES) for sign in "+−"}
#: Column and row of each face in the unfolded cube, chosen so that the four faces around +Y join at their edges.
CROSS = {"px": (2, 1), "nx": (0, 1), "py": (1, 0), "ny": (1, 2), "pz": (1, 1), "nz": (3, 1)}


def color_of(directions: np.ndarray) -> np.ndarray:
    """A pale color for each direction: red, green and blue grow along +X, +Y and +Z."""
    return 0.35 + 0.6 * (directions + 1) / 2


def signed_axis(name: str) -> np.ndarray:
    """The unit vector of +X … −Z."""
    return np.eye(3)[SIGNED_AXES[name]] * (1 if name[0] == "+" else -1) + 0.0


def name_of(direction: np.ndarray) -> str:
    """The name of the signed axis nearest to a direction."""
    return max(SIGNED_AXES, key=lambda name: float(signed_axis(name) @ direction))


def draw_frames(path: Path) -> None:
    """World axes, and one camera with its axes in both notations."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.2), subplot_kw={"projection": "3d"})
    pose = look_at(np.array([2.4, -1.6, 1.5]), np.zeros(3))
    titles = ("In memory: OpenCV axes", "In transforms.json: OpenGL axes")
    for panel, title, shown in zip(panels, titles, (pose, opencv_to_opengl(pose)), strict=True):
        for i, name in enumerate(AXIS_NAMES):
            _arrow(panel, np.zeros(3), 1.2 * np.eye(3)[i], AXIS_COLORS[i], f"world {name}")
            _arrow(panel, shown[:3, 3], 0.8 * shown[:3, i], AXIS_COLORS[i], name.lower())
        _frustum(panel, pose)
        panel.set(xlim=(0, 3), ylim=(-2, 1), zlim=(-0.2, 2.3), title=title)
        panel.set_box_aspect((3, 3, 2.5), zoom=1.75)
        panel.view_init(elev=22, azim=-62)
        panel.set_axis_off()
    figure.subplots_adjust(left=0, right=1, bottom=0, top=0.92, wspace=0)
    _save(figure, path)


def _arrow(panel, start: np.ndarray, vector: np.ndarray, color: str, label: str) -> None:
    panel.quiver(*start, *vector, color=color, arrow_length_ratio=0.12, linewidth=2)
    panel.text(*(start + 1.13 * vector), label, color=color, ha="center", fontsize=9)


def _frustum(panel, pose: np.ndarray) -> None:
    camera = Camera(pose, 1.2, 1.2, 0.5, 0.5, 1, 1)
    right, down, forward = 0.28 * camera.camera_to_world[:3, :3].T
    corners = [
        camera.position_world + 1.6 * forward + sx * right + sy * down
        for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    for corner, following in zip(corners, corners[1:] + corners[:1], strict=True):
        panel.plot(*zip(camera.position_world, corner, strict=True), color="0.55", linewidth=0.8)
        panel.plot(*zip(corner, following, strict=True), color="0.55", linewidth=0.8)


def draw_pixels(path: Path) -> None:
    """A 4×3 image: pixel (0, 0) spans [0, 1]², rays go through the centers."""
    width, height = 4, 3
    camera = Camera(np.eye(4), 2.0, 2.0, width / 2, height / 2, width, height)
    rays = ray_directions_world(camera)
    centers = rays[..., :2] / rays[..., 2:] * camera.fx + [camera.cx, camera.cy]
    figure, panel = plt.subplots(figsize=(5, 3.9))
    panel.plot(centers[..., 0].ravel(), centers[..., 1].ravel(), "o", color=AXIS_COLORS[2], label="pixel centers")
    panel.plot(camera.cx, camera.cy, "x", color=AXIS_COLORS[0], markersize=10, label="(cx, cy) = (W/2, H/2)")
    for row in range(height):
        for column in range(width):
            panel.text(column + 0.5, row + 0.8, f"row {row}, column {column}", ha="center", fontsize=6.5, color="0.35")
    panel.set(xlim=(-0.1, width + 0.1), ylim=(height + 0.1, -0.1), aspect="equal")
    panel.set(xticks=range(width + 1), yticks=range(height + 1), xlabel="x in pixels, to the right")
    panel.set_ylabel("y in pixels, downward")
    panel.grid(color="0.8")
    panel.legend(loc="upper center", bbox_to_anchor=(0.5, 1.16), ncols=2, frameon=False, fontsize=8)
    figure.tight_layout()
    _save(figure, path)


def draw_latlong(path: Path) -> None:
    """The lat-long map with the place of each axis."""
    figure, panel = plt.subplots(figsize=(7, 4))
    panel.imshow(color_of(latlong_directions(256)), extent=(0, 1, 1, 0), aspect=0.5)
    for name in SIGNED_AXES:
        u, v = directions_to_latlong(signed_axis(name))
        place = {"+Z": (u, 0.05), "−Z": (u, 0.95), "−X": (0.04, v)}.get(name, (u, v))
        panel.text(*place, name, ha="center", va="center", fontsize=13, weight="bold")
    panel.text(0.96, 0.5, "−X", ha="center", va="center", fontsize=13, weight="bold")
    panel.set(xlabel="u = ½ − atan2(y, x) / 2π", ylabel="v = acos(z) / π", xticks=np.linspace(0, 1, 5))
    panel.set(yticks=np.linspace(0, 1, 3))
    figure.tight_layout()
    _save(figure, path)


def draw_cube(path: Path) -> None:
    """The six faces as stored, each with its s and t axes, unfolded so that neighbors touch."""
    figure, panel = plt.subplots(figsize=(7.2, 5.6))
    for index, (name, face) in enumerate(zip(FACES, cube_directions(64), strict=True)):
        column, row = CROSS[name]
        panel.imshow(color_of(face), extent=(column, column + 1, row + 1, row))
        _face_label(panel, index, column, row)
    panel.set(xlim=(-0.02, 4.02), ylim=(3.02, -0.02), aspect="equal")
    panel.set_axis_off()
    figure.tight_layout()
    _save(figure, path)


def _face_label(panel: Axes, index: int, column: int, row: int) -> None:
    s_axis, t_axis, major = FACE_AXES[index]
    panel.text(
        column + 0.5, row + 0.72, f"{index}: {FACES[index]}\nlooks along {name_of(major)}", ha="center", va="center"
    )
    for end, text, anchor in (
        ((0.45, 0.08), f"s: {name_of(s_axis)}", (0.48, 0.085)),
        ((0.08, 0.45), f"t: {name_of(t_axis)}", (0.04, 0.5)),
    ):
        start = (column + 0.08, row + 0.08)
        panel.annotate("", (column + end[0], row + end[1]), start, arrowprops={"arrowstyle": "->"})
        panel.text(column + anchor[0], row + anchor[1], text, fontsize=8, va="center")
    panel.add_patch(plt.Rectangle((column, row), 1, 1, fill=False, color="white", linewidth=1.5))


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)


def main(folder: Path) -> None:
    """Draw every picture into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    draw_frames(folder / "frames.png")
    draw_pixels(folder / "pixels.png")
    draw_latlong(folder / "latlong.png")
    draw_cube(folder / "cube.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "images")
