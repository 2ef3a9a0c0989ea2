"""Commands that make pictures from scenes."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar, Literal

import tyro

from shinypartial.core.command_line import command_line
from shinypartial.io.events import LongCommand, report_result


@dataclass(frozen=True)
class CameraOptions:
    """The camera path, in keys of the recipe's [camera]; what is not given is the recipe's."""

    path: Literal["arc", "plus", "golden_spiral", "zigzag", "diamond", "around"] | None = None
    """Kind of path."""
    radius: float | None = None
    """Distance from the target in scene units; for a plus, that of its middle."""
    facing_azimuth_deg: float | None = None
    """Azimuth of the hemisphere's axis, from +X toward +Y: the side of the object that is photographed."""
    azimuth_deg: tuple[float, float] | None = None
    """First and last azimuth relative to the facing one."""
    elevation_deg: tuple[float, float] | None = None
    """First and last elevation from the horizon."""
    sweeps: int | None = None
    """Number of arcs, strokes of the zigzag or nested diamonds."""
    lens_mm: float | None = None
    """Focal length."""
    train: int | None = None
    """Number of training views."""
    test: int | None = None
    """Number of test views."""
    f_number: float | None = None
    """Focal length over the diameter of the aperture, for a scene unit of one meter; blurs what is out of focus."""
    motion_deg: float | None = None
    """Angle around the vertical through the target by which the camera moves during the exposure."""


@dataclass(frozen=True)
class SceneOptions:
    """Variations of a scene; what is not given is the recipe's."""

    world: str | None = None
    """What lights the scene: city, courtyard, forest, interior, night, studio, sunrise, sunset, or an EXR file."""
    surroundings_radii: float | None = None
    """From the origin to the nearest wall of a room that carries the world, in object radii; infinitely far when not
    given."""
    surroundings_room: Literal["sphere", "box"] | None = None
    """Shape of that room about the origin."""
    operator_height: float | None = None
    """Height in scene units of a figure at each camera that only reflections show; nobody is there when not given."""
    exposure: float | None = None
    """Photographic stops: multiplies the light by 2^exposure."""
    roughness: float | None = None
    """Of the object's material, from 0 (mirror) to 1."""
    base_color: tuple[float, float, float] | None = None
    """Of the object's material, linear, each from 0 to 1."""
    metallic: float | None = None
    """Of the object's material, from 0 to 1."""
    deformation: float | None = None
    """Root mean square in scene units of a seeded smooth displacement along the object's normals."""
    object_scale: float | None = None
    """Enlarges the object, and what stands around it, about the origin."""


@dataclass(frozen=True)
class Generate(LongCommand):
    """Render a benchmark dataset from a scene recipe; run again to continue where an earlier run stopped."""

    FIRST: ClassVar = (
        "scene object output resolution samples variation.world variation.roughness "
        "camera.path camera.train camera.test"
    )
    scene: str
    """Name of a scene in blender_scenes, or the path of a scene.toml or of a .blend file."""
    object: str | None = None
    """Name of the object of a .blend file that reflects; it becomes the mask."""
    output: Path | None = None
    """Folder to write; below datasets/, named after scene, path, resolution and variations when not given."""
    resolution: int | None = None
    """Pixels per side of the square images; the recipe's when not given (800 unless it says otherwise)."""
    samples: int | None = None
    """Samples per pixel; the recipe's when not given."""
    variation: tyro.conf.OmitArgPrefixes[SceneOptions] = SceneOptions()
    camera: tyro.conf.OmitArgPrefixes[CameraOptions] = CameraOptions()

    def work(self) -> None:
        """Make the dataset and say what to do next."""
        from shinypartial.dataset.read import DEFAULT_FOLDER
        from shinypartial.generate.dataset import generate
        from shinypartial.scene import find_scene, override, variant_name

        original = find_scene(self.scene, self.object)
        spec = override(
            original,
            resolution=self.resolution,
            samples=self.samples,
            **asdict(self.variation),
            **asdict(self.camera),
        )
        made = generate(spec, self.output or DEFAULT_FOLDER / variant_name(original, spec))
        if made.rendered:
            kept = f" (and kept {made.kept} that were there)" if made.kept else ""
            print(f"Rendered {made.rendered} views{kept} into {made.root}")
        else:
            print(f"Complete: all {made.kept} views are in {made.root}")
        print("Next: panoless fit")
        report_result({"dataset": made.root}, following=("panoless", "fit", made.root.resolve()))


@dataclass(frozen=True)
class Film:
    """Render the film or the photographs that a phone would take of a scene, with the truth beside them.

    Run again to continue.
    """

    scene: str | None = None
    """Name of a film in blender_scenes/films, or the path of its .toml file; all films there when not given."""
    output: Path | None = None
    """Folder to write, or the parent of the folders of all films; below films/ when not given."""
    resolution: int | None = None
    """Width of the pictures in pixels; the recipe's when not given."""
    frames: int | None = None
    """Frames of the film, or poses from which photographs are taken; the recipe's when not given."""
    test: int | None = None
    """Views by a steady pinhole for scores; the recipe's when not given."""
    samples: int | None = None
    """Samples per pixel; the recipe's when not given."""

    def run(self) -> None:
        """Make the film, or all of them, and say how to capture it."""
        from shinypartial.generate.film import DEFAULT_FOLDER
        from shinypartial.scene import film_names

        if self.scene:
            self._film(self.scene, self.output)
            return
        for name in film_names():
            self._film(name, (self.output or DEFAULT_FOLDER) / name)

    def _film(self, name: str, output: Path | None) -> None:
        from dataclasses import replace

        from shinypartial.generate.film import DEFAULT_FOLDER, FRAMES, MASKS, TRUTH, VIDEO, film
        from shinypartial.scene import Sphere, load_film, override

        spec = load_film(name)
        scene = override(
            spec.scene, resolution=self.resolution, samples=self.samples, train=self.frames, test=self.test
        )
        varied = replace(spec, scene=scene)
        root = output or DEFAULT_FOLDER / Path(name).stem
        made = film(varied, root)
        kept = f" (and kept {made.kept} that were there)" if made.kept else ""
        pictures, noun = (root / FRAMES, "photographs") if varied.photographs else (root / VIDEO, "frames")
        print(f"Recorded {made.recorded} {noun}{kept} into {pictures}; truth in {root / TRUTH}")
        words: list[str | Path] = ["panoless", "capture", pictures, "--output", Path("datasets", root.name)]
        if varied.photographs and isinstance(scene.object, Sphere):
            words += ["--object", "ball"]
        else:
            words += ["--masks", root / MASKS]
        if scene.ground and scene.ground.board:
            words += ["--board", scene.ground.board]
        print("Next:", command_line(*words))
