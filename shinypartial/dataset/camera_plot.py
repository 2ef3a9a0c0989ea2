"""A picture of a dataset's cameras from above and from the side, in the manner of a map."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.core.sphere import tangents
from shinypartial.core.trajectory import Trajectory
from shinypartial.io.files import atomic_write

CAMERA_PLOT = "cameras.png"
TRAIN_COLOR, TEST_COLOR, OBJECT_COLOR, BOUNDARY_COLOR = "#d95f02", "#1b9e77", "#111111", "#888888"
SIZE_INCHES = (10.0, 5.4)
DOTS_PER_INCH = 100
#: Length of a tick along the viewing direction, as a share of the largest distance from the object.
TICK_SHARE = 0.12
BOUNDARY_POINTS = 181
#: A palette of few colors keeps the file below 150 kB for thousands of cameras.
COLORS = 64


@dataclass(frozen=True)
class PlotView:
    """An orthographic look at the world: the axes of the paper in world coordinates and what to write at them."""

    title: str
    rightward: Float[np.ndarray, "3"]
    upward: Float[np.ndarray, "3"]
    rightward_label: str
    upward_label: str

    def project(self, points_world: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 2"]:
        """Place of world points on the paper."""
        return points_world @ np.stack([self.rightward, self.upward], -1)


def plot_cameras(path: Path, trajectory: Trajectory) -> None:
    """Write a PNG with two views, training and test cameras in two colors and a tick along each viewing direction.

    The object's place is marked, and the great circle that bounds the hemisphere is drawn at the distance of the
    farthest camera. The side view looks along the horizontal direction at right angles to the hemisphere's axis, or
    along +Y where cameras stand all around.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axis = trajectory.hemisphere_axis
    views = (top_view(), side_view(np.array([1.0, 0.0, 0.0]) if axis is None else axis))
    for view, axes in zip(views, figure.subplots(1, 2), strict=True):
        _draw(axes, view, trajectory)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    with atomic_write(path) as temporary:
        picture.quantize(COLORS).save(temporary, format="PNG", optimize=True)


def top_view() -> PlotView:
    """From above: +X to the right, +Y up."""
    return PlotView("from above", np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), "x", "y")


def side_view(axis: Float[np.ndarray, "3"]) -> PlotView:
    """From the side: the horizontal part of the hemisphere's axis to the right (+X when it has none), +Z up."""
    horizontal = np.array([axis[0], axis[1], 0.0])
    length = np.linalg.norm(horizontal)
    rightward = horizontal / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    azimuth = np.degrees(np.arctan2(rightward[1], rightward[0]))
    label = f"toward azimuth {azimuth:.0f}°".replace("-", "−")
    return PlotView("from the side", rightward, np.array([0.0, 0.0, 1.0]), label, "z")


def hemisphere_boundary(axis: Float[np.ndarray, "3"], radius: float) -> Float[np.ndarray, "P 3"]:
    """Points of the great circle at right angles to the axis, closed, about the origin."""
    first, second = tangents(axis)
    turn = np.linspace(0, 2 * np.pi, BOUNDARY_POINTS)[:, None]
    return radius * (np.cos(turn) * first + np.sin(turn) * second)


def _draw(axes: Any, view: PlotView, trajectory: Trajectory) -> None:
    cameras = (*trajectory.train, *trajectory.test)
    target = trajectory.target
    distance = max(float(np.linalg.norm(camera.position_world - target)) for camera in cameras)
    if trajectory.hemisphere_axis is not None:
        boundary = view.project(target + hemisphere_boundary(trajectory.hemisphere_axis, distance))
        axes.plot(*boundary.T, color=BOUNDARY_COLOR, linewidth=1, label="hemisphere boundary")
    _draw_split(axes, view, trajectory.test, distance, f"test ({len(trajectory.test)})", TEST_COLOR)
    _draw_split(axes, view, trajectory.train, distance, f"train ({len(trajectory.train)})", TRAIN_COLOR)
    axes.plot(*view.project(target), "*", color=OBJECT_COLOR, markersize=14, label="object", linestyle="none")
    axes.set(title=view.title, xlabel=view.rightward_label, ylabel=view.upward_label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.25)


def _draw_split(axes: Any, view: PlotView, cameras: Sequence[Camera], distance: float, label: str, color: str) -> None:
    from matplotlib.collections import LineCollection

    if not cameras:
        return
    positions = np.stack([camera.position_world for camera in cameras])
    forward = np.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    ticks = view.project(np.stack([positions, positions + TICK_SHARE * distance * forward], 1))
    axes.add_collection(LineCollection(list(ticks), colors=color, linewidths=0.7, alpha=0.6))
    axes.plot(*view.project(positions).T, ".", color=color, markersize=4, label=label)
