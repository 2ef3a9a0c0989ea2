"""One prediction folder to one folder of files for other programs."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from shinypartial.conversion.extension import write_for_extension
from shinypartial.conversion.gltf import write_glb
from shinypartial.conversion.light import Confidence, Layout, cube_faces, harmonics_of, light_of, seen_mask
from shinypartial.conversion.lobes import lobes_of
from shinypartial.conversion.room import room_of
from shinypartial.conversion.scenes import (
    ViewOf,
    mitsuba_scene,
    usd_scene,
    web_page,
    write_triangles,
)
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json, write_text
from shinypartial.io.images import write_exr_rgb, write_hdr, write_png
from shinypartial.prediction.format import read_info
from shinypartial.prediction.surface import surface_of

Target = Literal["blender", "cubemap", "sh", "sg", "glb", "mitsuba", "usd", "threejs", "mask", "room", "extension"]

WORLD, BLEND, HARMONICS, GLB = "world.exr", "scene.blend", "harmonics.json", "surface.glb"
LOBES, MASK, MITSUBA, MITSUBA_SURFACE = "lobes.json", "mask.png", "scene.xml", "surface.ply"
USD, PAGE, ROOM = "scene.usda", "index.html", "room.json"
WITH_SURFACE = {"blender", "glb", "mitsuba", "usd", "threejs"}
WITH_WORLD = {"blender", "mitsuba", "usd"}


def convert(
    prediction: Path,
    targets: Sequence[Target],
    output: Path,
    *,
    confidence: Confidence = "keep",
    layout: Layout = "three",
    degree: int = 4,
    lobes: int = 24,
    feather_deg: float = 5.0,
) -> list[Path]:
    """Write what each target needs into the folder `output`; return the files.

    In directions that were not seen, `confidence` keeps what the prediction has there, darkens it by the visibility, or
    fills it from around. `layout` is that of cube maps, `degree` that of spherical harmonics, `lobes` the number of
    spherical Gaussians; over `feather_deg` the mask of what was seen falls to zero, inward.
    Raises InputError when the prediction lacks what a target needs, or when Blender can't be loaded.
    """
    info, written = read_info(prediction), []
    reflectance = info.reflectance or (1.0, 1.0, 1.0)
    surface = surface_of(prediction) if WITH_SURFACE & set(targets) else None
    if "glb" in targets and surface is None:
        raise InputError(
            expected=f"a PLY with faces in {prediction}, for --to glb",
            found="no surface, or a cloud of points such as surfels",
            remedy="Leave glb out; or fit a surface, such as with `panoless fit --model free_form`.",
        )
    if "glb" in targets and surface is not None:
        write_glb(output / GLB, surface, reflectance)
        written.append(output / GLB)
    if "mask" in targets:
        write_png(output / MASK, np.rint(255 * seen_mask(prediction, feather_deg)).astype(np.uint8))
        written.append(output / MASK)
    if "room" in targets:
        write_json(output / ROOM, room_of(prediction))
        written.append(output / ROOM)
    if "extension" in targets:
        written += write_for_extension(prediction, output)
    if set(targets) <= {"glb", "mask", "room", "extension"}:
        return written
    light = np.maximum(light_of(prediction, confidence), 0)
    if "sh" in targets:
        write_json(output / HARMONICS, harmonics_of(light, degree))
        written.append(output / HARMONICS)
    if "sg" in targets:
        write_json(output / LOBES, lobes_of(light, lobes))
        written.append(output / LOBES)
    if "cubemap" in targets:
        for name, face in zip(FACES, cube_faces(light, layout), strict=True):
            write_hdr(output / f"{name}.hdr", face.astype(np.float32))
            written.append(output / f"{name}.hdr")
    if WITH_WORLD & set(targets):
        write_exr_rgb(output / WORLD, light)
        written.append(output / WORLD)
    if "mitsuba" in targets:
        if surface is not None:
            write_triangles(output / MITSUBA_SURFACE, surface)
            written.append(output / MITSUBA_SURFACE)
        beside = None if surface is None else MITSUBA_SURFACE
        write_text(output / MITSUBA, mitsuba_scene(WORLD, beside, reflectance, ViewOf(surface)))
        written.append(output / MITSUBA)
    if "usd" in targets:
        write_text(output / USD, usd_scene(WORLD, surface, reflectance))
        written.append(output / USD)
    if "threejs" in targets:
        with tempfile.TemporaryDirectory() as scratch:
            hdr, glb = Path(scratch) / "light.hdr", Path(scratch) / GLB
            write_hdr(hdr, light.astype(np.float32))
            if surface is not None:
                write_glb(glb, surface, reflectance)
            write_text(output / PAGE, web_page(hdr.read_bytes(), None if surface is None else glb.read_bytes()))
        written.append(output / PAGE)
    if "blender" in targets:
        from shinypartial.blender.mirror_scene import write_mirror_scene

        write_mirror_scene(output / BLEND, output / WORLD, surface, reflectance)
        written.append(output / BLEND)
    return written
