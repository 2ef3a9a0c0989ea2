"""The commands that hand a prediction to other programs, show its light, and take one from other methods' code."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from shinypartial.cli.newest import announce_newest
from shinypartial.conversion.layouts import LayoutName
from shinypartial.io.events import LongCommand, report_result

Target = Literal["blender", "cubemap", "sh", "sg", "glb", "mitsuba", "usd", "threejs", "mask", "room", "extension"]


@dataclass(frozen=True)
class Convert(LongCommand):
    """Write the light and the surface of a prediction as files for Blender, game engines and web pages."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder of any method; the newest one when not given."""
    to: tuple[Target, ...] = field(kw_only=True)
    """What to write, one or more: `blender` world.exr and scene.blend; `cubemap` px.hdr to nz.hdr; `sh`
    harmonics.json; `sg` lobes.json; `glb` surface.glb; `mitsuba` scene.xml; `usd` scene.usda; `threejs` index.html;
    `mask` mask.png of what was seen; `room` room.json of near surroundings; `extension`
    scene.json and what it names, for the Blender extension."""
    output: Path | None = None
    """Folder to write; PREDICTION-converted beside it when not given."""
    confidence: Literal["keep", "darken", "fill"] = "keep"
    """Directions that were not seen: `keep` what the prediction has there, `darken` by the visibility, or `fill`
    smoothly from around where the visibility is 0. Maps of `panoless fit` are filled already."""
    layout: Literal["three", "opengl"] = "three"
    """Of cube maps: for three.js, whose lookups mirror x, or for lookups in the direction itself."""
    degree: int = 4
    """Of spherical harmonics, 0 to 4."""
    lobes: int = 24
    """Number of spherical Gaussians, 1 to 512."""
    feather_deg: float = 5.0
    """Width over which the mask falls to zero, inward from the border of what was seen."""

    def work(self) -> None:
        """Write and say what."""
        from shinypartial.conversion.convert import convert
        from shinypartial.prediction.format import newest_prediction

        prediction = self.prediction or announce_newest("prediction", newest_prediction())
        output = self.output or prediction.resolve().with_name(f"{prediction.resolve().name}-converted")
        written = convert(
            prediction,
            self.to,
            output,
            confidence=self.confidence,
            layout=self.layout,
            degree=self.degree,
            lobes=self.lobes,
            feather_deg=self.feather_deg,
        )
        for path in written:
            print(f"Wrote {path}")
        report_result({"folder": output} | {path.name: path for path in written})


@dataclass(frozen=True)
class Relight:
    """Render an object of yours in the recovered light: before, after and, of a dataset, in the true light."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder of any method; the newest one when not given."""
    object: Path | None = None
    """A .blend, .glb or .gltf; three balls, mirror, metal and matte, when not given."""
    dataset: Path | None = None
    """Dataset whose true light is rendered, too."""
    output: Path | None = None
    """Folder to write; PREDICTION-relit beside it when not given."""
    confidence: Literal["keep", "darken", "fill"] = "keep"
    """Directions that were not seen, as for `convert`."""
    resolution: int = 512
    """Pixels along the width."""
    samples: int = 64
    """Paths a pixel."""

    def run(self) -> None:
        """Render and say what was written."""
        from shinypartial.conversion.relight import relight
        from shinypartial.prediction.format import newest_prediction

        prediction = self.prediction or announce_newest("prediction", newest_prediction())
        output = self.output or prediction.resolve().with_name(f"{prediction.resolve().name}-relit")
        relit = relight(
            prediction,
            output,
            source=self.object,
            dataset=self.dataset,
            confidence=self.confidence,
            resolution=self.resolution,
            samples=self.samples,
        )
        for path in relit.pictures.values():
            print(f"Wrote {path}")
        if relit.psnr_srgb is not None:
            print(f"In the recovered light it looks as in the true one to {relit.psnr_srgb:.1f} dB.")


@dataclass(frozen=True)
class Import:
    """Make a prediction folder of what another method's code wrote, to be evaluated like any other."""

    layout: tyro.conf.Positional[LayoutName]
    """Whose code wrote it; docs/how-to/compare-methods.md lists the commits that define the layouts."""
    folder: tyro.conf.Positional[Path]
    """The method's output folder (its --model_path)."""
    dataset: Path = field(kw_only=True)
    """Dataset folder that it was trained on."""
    output: Path = field(kw_only=True)
    """Prediction folder to write, new or empty."""
    iteration: int | None = None
    """The last one that was saved when not given."""
    background: Literal["white", "black"] | None = None
    """Behind the object in its renders; as its cfg_args says when not given."""
    seconds: float | None = None
    """How long it trained, which its folder lacks."""
    device: str | None = None
    """What it trained on, such as "NVIDIA RTX 4090"."""

    def run(self) -> None:
        """Write and say what."""
        from shinypartial.conversion.outside import Cost, import_result

        imported = import_result(
            self.layout,
            self.folder,
            self.dataset,
            self.output,
            iteration=self.iteration,
            background=self.background,
            cost=Cost(self.seconds, self.device),
        )
        views = f"{imported.test_views} test views" if imported.test_views else "no test views"
        print(f"Wrote {self.output}: {imported.info.method}, iteration {imported.info.config['iteration']}, {views}")
        for reason in imported.left_out:
            print(f"Left out {reason}")
