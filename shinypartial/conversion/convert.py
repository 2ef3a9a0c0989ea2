"""One prediction folder to one folder of files for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from shinypartial.conversion.light import Confidence, Layout, cube_faces, harmonics_of, light_of
from shinypartial.conversion.surface import surface_of, write_glb
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.io.files import write_json
from shinypartial.io.images import write_exr_rgb, write_hdr
from shinypartial.prediction.format import read_info

Target = Literal["blender", "cubemap", "sh", "glb"]

WORLD, BLEND, HARMONICS, GLB = "world.exr", "scene.blend", "harmonics.json", "surface.glb"


@dataclass(frozen=True)
class ConversionOptions:
    """How light is written."""

    confidence: Confidence = "keep"
    """Directions that were not seen: `keep` what the prediction has there; `darken`: light times visibility; `fill`:
    smoothly from around where the visibility is 0."""
    layout: Layout = "three"
    """Of cube maps: `three` for three.js, whose lookups mirror x; `opengl` for lookups in the direction itself."""
    degree: int = 4
    """Of spherical harmonics, at most 4."""


def convert(
    prediction: Path, targets: Sequence[Target], output: Path, options: ConversionOptions = ConversionOptions()
) -> list[Path]:
    """Write what each target needs into the folder `output`; return the files.

    Raises InputError when the prediction lacks what a target needs, or when Blender can't be loaded.
    """
    info, written = read_info(prediction), []
    reflectance = info.reflectance or (1.0, 1.0, 1.0)
    surface = surface_of(prediction) if {"blender", "glb"} & set(targets) else None
    if "glb" in targets and surface is None:
        raise InputError(
            expected=f"a PLY with faces in {prediction}, for --to glb",
            found="no surface, or a cloud of points such as surfels",
            remedy="Leave glb out; or fit a surface, such as with `panoless fit --model free_form`.",
        )
    if "glb" in targets and surface is not None:
        write_glb(output / GLB, surface, reflectance)
        written.append(output / GLB)
    if set(targets) == {"glb"}:
        return written
    light = np.maximum(light_of(prediction, options.confidence), 0)
    if "sh" in targets:
        write_json(output / HARMONICS, harmonics_of(light, options.degree))
        written.append(output / HARMONICS)
    if "cubemap" in targets:
        for name, face in zip(FACES, cube_faces(light, options.layout), strict=True):
            write_hdr(output / f"{name}.hdr", face.astype(np.float32))
            written.append(output / f"{name}.hdr")
    if "blender" in targets:
        from shinypartial.blender.mirror_scene import write_mirror_scene

        write_exr_rgb(output / WORLD, light)
        write_mirror_scene(output / BLEND, output / WORLD, surface, reflectance)
        written += [output / WORLD, output / BLEND]
    return written
