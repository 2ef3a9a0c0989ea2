"""Render views of an assembled scene and hand back their passes as arrays."""

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from shinypartial.blender.assemble import assemble
from shinypartial.blender.materials import DEPTH_PASS
from shinypartial.blender.objects import BODY
from shinypartial.blender.region import image_region, set_border, world_vertices
from shinypartial.blender.runtime import import_blender, interrupts_deferred, quiet, set_threads
from shinypartial.blender.self_reflection import render_probe
from shinypartial.camera import Camera, opencv_to_opengl
from shinypartial.errors import InputError
from shinypartial.scene import BlendFile, SceneSpec

DEPTH_CHANNEL = f"{DEPTH_PASS}.X"
PASSES = (*(f"Combined.{name}" for name in "RGBA"), *(f"Normal.{name}" for name in "XYZ"), DEPTH_CHANNEL)
PROBE_PASSES = ("Combined.R",)


@dataclass(frozen=True)
class RenderedView:
    """What Blender knows about one view, averaged over the area of each pixel.

    `radiance` is linear and premultiplied by `alpha`; `normals_world` are unit vectors that face the camera where
    alpha > 0 and zero elsewhere; `depth` is z along the optical axis in scene units, zero where alpha is zero.
    `self_reflection`, of the pixel's center and not averaged, is 1 where the mirror ray meets the object or a prop.
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
    scratch: Path
    device: str
    blender_version: str
    body_vertices_world: Float[np.ndarray, "P 3"]

    def render(self, camera: Camera) -> RenderedView:
        """Render one view from a camera with the recipe's lens and resolution."""
        scene = self.bpy.context.scene
        path, probe = self.scratch / "view.exr", self.scratch / "probe.exr"
        scene.camera.matrix_world = opencv_to_opengl(camera.camera_to_world).T.tolist()
        scene.render.filepath = str(path)
        region = image_region(camera, self.body_vertices_world)
        for each in self.bpy.data.scenes:
            set_border(each, region, camera)
        try:
            with interrupts_deferred(), quiet():
                self.bpy.ops.render.render(write_still=True)
                render_probe(self.bpy, probe)
        except RuntimeError as error:
            raise InputError(
                expected=f"Blender to render a view and to write it to {self.scratch}",
                found=" ".join(str(error).split()),
                remedy="Free some space there or set TMPDIR to another folder, then run the same command again.",
            ) from None
        return _from_passes(_read_passes(path, PASSES), _read_passes(probe, PROBE_PASSES))


@contextlib.contextmanager
def open_renderer(spec: SceneSpec, *, threads: int | None = None, folder: Path | None = None) -> Iterator[Renderer]:
    """Assemble the scene; its passes go through a temporary folder, inside `folder`, that is removed at the end.

    Cycles uses as many `threads` on the CPU, or one for every core.
    """
    bpy = import_blender()
    with tempfile.TemporaryDirectory(prefix="shinypartial-", dir=folder) as scratch:
        with interrupts_deferred(), quiet():
            device = assemble(bpy, spec)
            set_threads(bpy, threads)
            vertices = _body_vertices(bpy, spec)
        yield Renderer(bpy, Path(scratch), device, bpy.app.version_string, vertices)


def _body_vertices(bpy: Any, spec: SceneSpec) -> Float[np.ndarray, "P 3"]:
    """Those that bound the object; none for a user's file, whose displacements and modifiers may differ in renders."""
    if isinstance(spec.object, BlendFile):
        return np.zeros((0, 3))
    return world_vertices(bpy, bpy.context.scene.objects[BODY])


def _read_passes(path: Path, expected: tuple[str, ...]) -> dict[str, Float[np.ndarray, "H W"]]:
    """Every channel of every part, by the name that follows the view layer's."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            passes = {
                name.partition(".")[2]: channel.pixels.astype(np.float32)
                for part in file.parts
                for name, channel in part.channels.items()
            }
    except Exception as error:
        raise _unreadable(path, str(error).strip()) from None
    missing = sorted(set(expected) - passes.keys())
    if missing:  # Where a part is cut off, OpenEXR warns and leaves it out.
        raise _unreadable(path, f"no {', '.join(missing)}")
    return passes


def _unreadable(path: Path, found: str) -> InputError:
    return InputError(
        expected=f"every pass that Blender writes to {path}",
        found=f"an incomplete file ({found})",
        remedy="Free some space there or set TMPDIR to another folder, then run the same command again.",
    )


def _from_passes(
    passes: dict[str, Float[np.ndarray, "H W"]], probe: dict[str, Float[np.ndarray, "H W"]]
) -> RenderedView:
    """Normals and depth are averages over the pixel, zero where it misses: divide by alpha, or renormalize."""
    alpha = np.clip(passes["Combined.A"], 0, 1)
    inside = alpha > 0
    radiance = np.stack([passes[f"Combined.{name}"] for name in "RGB"], -1)
    normals = np.stack([passes[f"Normal.{name}"] for name in "XYZ"], -1)
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.finfo(np.float32).tiny)
    depth = passes[DEPTH_CHANNEL] / np.where(inside, alpha, 1)
    return RenderedView(
        np.where(inside[..., None], radiance, 0),
        alpha,
        np.where(inside[..., None], normals / length, 0),
        np.where(inside, depth, 0),
        np.where(inside, (probe[PROBE_PASSES[0]] > 0.5).astype(np.float32), 0),
    )
