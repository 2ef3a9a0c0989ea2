"""Objects that are more than mirrors to scores: `python -m tests.benchmarks.bench_materials --output /tmp/materials`.

The shape of a development scene gets a material that differs from place to place and is rendered in a world; then
`panoless fit` and `shinypartial evaluate` run on it:

- **label**: a matte checkerboard over a part of a mirror,
- **dirt**: matte stains on a mirror,
- **glaze**: 40 % metal over a base color that changes along the surface.

`--shapes sculpture --materials label` is a short run. Folders that are there are used as they are.
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from shinypartial.blender.assemble import assemble
from shinypartial.io.files import read_json, write_json
from shinypartial.scene.recipes import load_scene

OBJECT = "object"
WORLDS = {"sculpture": "sunrise", "vase": "courtyard"}
SCORES = {
    "environment_psnr_linear": "environment.as_predicted.full.psnr_linear",
    "render_psnr": "render.psnr",
    "normals_median_deg": "normals.median_angular_error_deg",
    "normals_mean_deg": "normals.mean_angular_error_deg",
}


@dataclass(frozen=True)
class Options:
    """Render, fit and score."""

    output: Path
    """Folder for files of Blender, datasets and fits."""
    shapes: tuple[str, ...] = tuple(WORLDS)
    """Development scenes whose shapes are taken."""
    materials: tuple[str, ...] = ("label", "dirt", "glaze")
    resolution: int = 200
    train: int = 50
    samples: int = 24
    json: Path | None = None
    """Also write the summary here."""


def main() -> None:
    """Print the summary as JSON."""
    options = tyro.cli(Options, description=__doc__)
    options.output.mkdir(parents=True, exist_ok=True)
    results = [_scored(shape, material, options) for shape in options.shapes for material in options.materials]
    print(json.dumps(results, indent=1))
    if options.json:
        write_json(options.json, {"results": results})


def _scored(shape: str, material: str, options: Options) -> dict[str, Any]:
    name = f"{shape}-{material}"
    file, dataset, fit = (options.output / each for each in (f"{name}.blend", name, f"{name}-fit"))
    if not dataset.exists():
        _write_blend(shape, material, file)
        size = [f"--{each}={getattr(options, each)}" for each in ("resolution", "train", "samples")]
        scene = [f"--scene={file}", f"--object={OBJECT}", f"--world={WORLDS.get(shape, 'sunrise')}", "--test=5"]
        _run("shinypartial", "generate", *scene, *size, f"--output={dataset}")
    _run("panoless", "fit", str(dataset), f"--output={fit}")
    _run("shinypartial", "evaluate", str(fit), f"--dataset={dataset}")
    scores, info = read_json(fit / "scores.json", "scores"), read_json(fit / "prediction.json", "a prediction")
    found = {key: _value(scores, path) for key, path in SCORES.items()}
    return {
        "name": name,
        **found,
        "uneven": info.get("uneven"),
        "verdict": info["verdict"]["verdict"],
        "seconds": sum(info["seconds"].values()),
    }


def _value(scores: Any, path: str) -> float | None:
    for key in path.split("."):
        scores = scores.get(key) if isinstance(scores, dict) else None
    return None if scores is None else float(scores)


def _run(*command: str) -> None:
    """One of the commands, by the interpreter that runs this."""
    module, *arguments = command
    subprocess.run([sys.executable, "-m", f"{module}.cli", *arguments], check=True, stdout=sys.stderr)


def _write_blend(shape: str, material: str, file: Path) -> None:
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    assemble(bpy, load_scene(shape))
    for other in [each for each in bpy.data.objects if each.name != OBJECT]:
        bpy.data.objects.remove(other)
    mesh = bpy.data.objects[OBJECT].data
    mesh.materials.clear()
    mesh.materials.append(_material(bpy, material))
    bpy.ops.wm.save_as_mainfile(filepath=str(file))


def _material(bpy: Any, kind: str) -> Any:
    material = bpy.data.materials.new(kind)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    link = tree.links.new

    def node(name: str, **inputs: Any) -> Any:
        found = tree.nodes.new(f"ShaderNode{name}")
        for key, value in inputs.items():
            socket = found.inputs[key.replace("_", " ")]
            link(value, socket) if hasattr(value, "links") else setattr(socket, "default_value", value)
        return found

    def math(operation: str, first: Any, second: Any) -> Any:
        found = tree.nodes.new("ShaderNodeMath")
        found.operation = operation
        for socket, value in zip(found.inputs, (first, second), strict=False):
            link(value, socket) if hasattr(value, "links") else setattr(socket, "default_value", value)
        return found.outputs[0]

    place = node("TexCoord").outputs["Object"]
    shader: Any
    if kind == "glaze":
        ramp = node("ValToRGB", Fac=node("TexNoise", Vector=place, Scale=2.0).outputs[0])
        ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (0.1, 0.3, 0.5, 1), (0.6, 0.5, 0.3, 1)
        shader = node("BsdfPrincipled", Base_Color=ramp.outputs[0], Metallic=0.4, Roughness=0.0)
    else:
        if kind == "label":
            x, y, z = node("SeparateXYZ", Vector=place).outputs
            across = math("LESS_THAN", math("ABSOLUTE", x, 0.0), 0.38)
            along = math("LESS_THAN", math("ABSOLUTE", math("SUBTRACT", z, 0.1), 0.0), 0.3)
            share = math("MULTIPLY", math("MULTIPLY", across, along), math("LESS_THAN", y, 0.0))
            colors = {"Color1": (0.8, 0.75, 0.6, 1), "Color2": (0.5, 0.05, 0.05, 1)}
            color: Any = node("TexChecker", Vector=place, Scale=9.0, **colors).outputs["Color"]
        else:
            noise = node("TexNoise", Vector=place, Scale=3.0).outputs[0]
            share = node("MapRange", Value=noise, From_Min=0.52, From_Max=0.62).outputs[0]
            color = (0.25, 0.15, 0.08, 1)
        mirror = node("BsdfPrincipled", Metallic=1.0, Roughness=0.0, Base_Color=(1, 1, 1, 1)).outputs[0]
        matte = node("BsdfPrincipled", Metallic=0.0, Roughness=1.0, Base_Color=color).outputs[0]
        shader = tree.nodes.new("ShaderNodeMixShader")
        for socket, value in zip(shader.inputs, (share, mirror, matte), strict=True):
            link(value, socket)
    link(shader.outputs[0], node("OutputMaterial").inputs[0])
    return material


if __name__ == "__main__":
    main()
