"""Render views of an assembled scene and hand back their passes as arrays.

Where the object mirrors a far world perfectly, paths through a grid of points determine what smooth pixels show
(`directions`, `footprint`), and only the others are path traced (`sparse_pixels`). Anything else is path traced as a
whole.
"""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from shinypartial.blender.assemble import assemble, world_radiance
from shinypartial.blender.backdrop import render_backdrop, set_size, show_backdrop
from shinypartial.blender.cameras import set_view
from shinypartial.blender.directions import (
    GRID,
    MISSED,
    MirrorPaths,
    assemble_directions,
    mirrors_enough,
    render_directions,
)
from shinypartial.blender.footprint import FarWorld, SmoothLight, smooth_light
from shinypartial.blender.objects import BODY, props_of
from shinypartial.blender.passes import (
    ALPHA_CHANNEL,
    COLOR_CHANNELS,
    DEPTH_CHANNEL,
    NORMAL_CHANNELS,
    PASSES,
    Passes,
    read_passes,
    stacked,
)
from shinypartial.blender.region import SMALLEST_DEPTH, Region, image_region, set_border, world_vertices
from shinypartial.blender.runtime import import_blender, interrupts_deferred, quiet, set_threads
from shinypartial.blender.self_reflection import render_probe
from shinypartial.blender.sparse_pixels import assemble_sparse, nearest_depth, render_sparse
from shinypartial.core.camera import Camera, ray_directions_world
from shinypartial.core.errors import InputError
from shinypartial.core.trajectory import CameraPath
from shinypartial.scene import BlendFile, SceneSpec

PROBE_PASSES = (COLOR_CHANNELS[0],)
#: With more samples every pixel is path traced, which has no limit but time.
MOST_SAMPLES_OF_MIRRORS = 512
#: Cosine from which a normal faces away from the camera; at silhouettes, interpolated normals come to 0.01.
LEAST_AWAY = 0.02
SPARSE_ATTEMPTS = 3


@dataclass(frozen=True)
class RenderedView:
    """What Blender knows about one view, averaged over the area of each pixel.

    `radiance` is linear and premultiplied by `alpha`; `normals_world` are unit vectors that face the camera where
    alpha > 0 and zero elsewhere; `depth` is z along the optical axis in scene units, zero where alpha is zero.
    `self_reflection`, of the pixel's center and not averaged, is 1 where the mirror ray meets the object, a prop or the
    operator. With an aperture or in motion, all others are also averages over the aperture and the exposure.
    """

    radiance: Float[np.ndarray, "H W 3"]
    alpha: Float[np.ndarray, "H W"]
    normals_world: Float[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"]
    self_reflection: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class Renderer:
    """An assembled scene; Blender holds one at a time in a process."""

    bpy: Any
    spec: CameraPath
    scratch: Path
    device: str
    body_vertices_world: Float[np.ndarray, "P 3"]
    mirror: "_Mirror | None"
    """What a perfectly mirroring object is rendered with; None where every pixel is path traced."""

    def render(self, camera: Camera) -> RenderedView:
        """Render one view with the recipe's lens, of the camera's size."""
        region = image_region(camera, self.body_vertices_world)
        with self._at(camera, backdrop=False):
            if self.mirror and (depth := nearest_depth(camera, self.mirror.vertices_world)) > SMALLEST_DEPTH:
                return self._reflected(self.mirror, camera, region, depth)
            return self._path_traced(camera, region)

    def render_backdrop(self, camera: Camera) -> Float[np.ndarray, "H W 3"]:
        """Radiance of what a camera sees around the object and, where that stands, behind it."""
        path = self.scratch / "backdrop.exr"
        with self._at(camera, backdrop=True):
            render_backdrop(self.bpy, path)
        return stacked(read_passes(path, COLOR_CHANNELS), COLOR_CHANNELS)

    @contextlib.contextmanager
    def _at(self, camera: Camera, *, backdrop: bool) -> Iterator[None]:
        """Move the camera there, and raise InputError where Blender fails within the block."""
        set_view(self.bpy, camera, self.spec)
        show_backdrop(self.bpy, backdrop)
        set_size(self.bpy, camera.width, camera.height)
        try:
            with interrupts_deferred(), quiet():
                yield
        except RuntimeError as error:
            raise InputError(
                expected=f"Blender to render a view and to write it to {self.scratch}",
                found=" ".join(str(error).split()),
                remedy="Free some space there or set TMPDIR to another folder, then run the same command again.",
            ) from None

    def _path_traced(self, camera: Camera, region: Region) -> RenderedView:
        """Every pixel of the region alike, and the probe of self-reflection."""
        scene = self.bpy.context.scene
        path, probe = self.scratch / "view.exr", self.scratch / "probe.exr"
        for each in self.bpy.data.scenes:
            set_border(each, region, camera)
        scene.render.filepath = str(path)
        self.bpy.ops.render.render(write_still=True)
        render_probe(self.bpy, probe)
        meets_scene = read_passes(probe, PROBE_PASSES)[PROBE_PASSES[0]] > 0.5
        view = _from_passes(read_passes(path, PASSES), meets_scene)
        return view if self.spec.is_ideal else _turned_to(camera, view)

    def _reflected(self, mirror: "_Mirror", camera: Camera, region: Region, depth: float) -> RenderedView:
        """Smooth pixels from their paths, path tracing in the others."""
        paths = render_directions(self.bpy, self.scratch / "directions.exr", region, camera)
        light = smooth_light(mirror.world, paths, mirror.threads)
        passes = {name: np.zeros((camera.height, camera.width), np.float32) for name in PASSES}
        inside = slice(region.top, region.bottom), slice(region.left, region.right)
        for name, channel in _smooth_passes(light, paths).items():
            passes[name][inside] = channel
        unsure = np.zeros((camera.height, camera.width), bool)
        unsure[inside] = _near_the_object(paths) & ~light.smooth
        self._path_trace_pixels(passes, unsure, camera, depth)
        meets_scene = np.zeros(unsure.shape, bool)
        meets_scene[inside] = paths.meets_scene[GRID // 2 :: GRID, GRID // 2 :: GRID]
        return _from_passes(passes, meets_scene)

    def _path_trace_pixels(self, passes: Passes, unsure: Bool[np.ndarray, "H W"], camera: Camera, depth: float) -> None:
        """Fill the passes at the unsure pixels.

        A sample at the very border of a pixel may be rounded into its neighbor in the small image, which stands for
        another place of the view. Where a normal betrays it by facing away, the pixel is traced again among others.
        """
        rays = ray_directions_world(camera)
        for _ in range(SPARSE_ATTEMPTS):
            if not unsure.any():
                return
            sparse = render_sparse(self.bpy, self.scratch / "sparse.exr", unsure, depth)
            for name in PASSES:
                passes[name][unsure] = sparse[name]
            facing = np.sum(stacked(passes, NORMAL_CHANNELS) * rays, -1)
            unsure = unsure & (facing > LEAST_AWAY * passes[ALPHA_CHANNEL])


@dataclass(frozen=True)
class _Mirror:
    """The far world, and the vertices of everything before the camera."""

    world: FarWorld
    vertices_world: Float[np.ndarray, "P 3"]
    threads: int


@contextlib.contextmanager
def open_renderer(
    spec: SceneSpec, *, threads: int | None = None, folder: Path | None = None, path_traced: bool = False
) -> Iterator[Renderer]:
    """Assemble the scene; its passes go through a temporary folder, inside `folder`, that is removed at the end.

    Cycles uses as many `threads` on the CPU, or one for every core. Every pixel is path traced where `path_traced`
    requests it, or where samples are many, or the object is no perfect mirror in a far world.
    """
    bpy = import_blender()
    with tempfile.TemporaryDirectory(prefix="shinypartial-", dir=folder) as scratch:
        with interrupts_deferred(), quiet():
            device = assemble(bpy, spec)
            vertices = _body_vertices(bpy, spec)
            mirror = None
            if not path_traced and spec.render.samples <= MOST_SAMPLES_OF_MIRRORS and mirrors_enough(bpy, spec):
                mirror = _prepare_mirror(bpy, spec, vertices, threads or os.cpu_count() or 1)
            set_threads(bpy, threads)
        yield Renderer(bpy, spec.camera, Path(scratch), device, vertices, mirror)


def _prepare_mirror(bpy: Any, spec: SceneSpec, body: Float[np.ndarray, "P 3"], threads: int) -> _Mirror:
    """Add the two scenes that a perfect mirror needs."""
    props = [world_vertices(bpy, each) for each in props_of(bpy.context.scene)]
    assemble_directions(bpy, spec)
    assemble_sparse(bpy)
    return _Mirror(FarWorld(world_radiance(spec.world, spec.render.exposure)), np.concatenate([body, *props]), threads)


def _body_vertices(bpy: Any, spec: SceneSpec) -> Float[np.ndarray, "P 3"]:
    """Those that bound the object, as far as it appears where they do.

    None for a user's file, whose displacements and modifiers may differ in renders, and for blurred pictures.
    """
    if isinstance(spec.object, BlendFile) or not spec.camera.is_ideal:
        return np.zeros((0, 3))
    return world_vertices(bpy, bpy.context.scene.objects[BODY])


def _smooth_passes(light: SmoothLight, paths: MirrorPaths) -> Passes:
    """Passes of the smooth pixels, which the object covers; zero in the others."""
    channels = {
        DEPTH_CHANNEL: paths.depth,
        **dict(zip(NORMAL_CHANNELS, np.moveaxis(paths.normals_world, -1, 0), strict=True)),
    }
    means = {name: np.where(light.smooth, _pixels(channel).mean((1, 3)), 0) for name, channel in channels.items()}
    colors = dict(zip(COLOR_CHANNELS, np.moveaxis(light.radiance, -1, 0), strict=True))
    return {**means, **colors, ALPHA_CHANNEL: light.smooth.astype(np.float32)}


def _near_the_object(paths: MirrorPaths) -> Bool[np.ndarray, "h w"]:
    """Pixels in which a path meets the object, and those next to them."""
    from scipy.ndimage import binary_dilation

    seen = _pixels(paths.bounces != MISSED).any((1, 3))
    return binary_dilation(seen, np.ones((3, 3), bool))


def _pixels(points: Any) -> Any:
    """The two axes of a grid of points as (row, row within, column, column within) of pixels."""
    height, width = points.shape
    return points.reshape(height // GRID, GRID, width // GRID, GRID)


def _from_passes(passes: Passes, meets_scene: Bool[np.ndarray, "H W"]) -> RenderedView:
    """Normals and depth are averages over the pixel, zero where it misses: divide by alpha, or renormalize."""
    alpha = np.clip(passes[ALPHA_CHANNEL], 0, 1)
    inside = alpha > 0
    normals = stacked(passes, NORMAL_CHANNELS)
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.finfo(np.float32).tiny)
    return RenderedView(
        np.where(inside[..., None], stacked(passes, COLOR_CHANNELS), 0),
        alpha,
        np.where(inside[..., None], normals / length, 0),
        np.where(inside, passes[DEPTH_CHANNEL] / np.where(inside, alpha, 1), 0),
        np.where(inside, meets_scene, 0).astype(np.float32),
    )


def _turned_to(camera: Camera, view: RenderedView) -> RenderedView:
    """The view with each normal that faces away from the middle of aperture and exposure turned until it faces aside.

    Other points of the aperture and moments of the exposure see a little farther around the silhouette.
    """
    rays = ray_directions_world(camera)
    away = np.maximum(np.sum(view.normals_world * rays, -1, keepdims=True), 0)
    normals = view.normals_world - away * rays
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.finfo(np.float32).tiny)
    return replace(view, normals_world=(normals / length).astype(np.float32))
