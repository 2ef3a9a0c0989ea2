"""Commands that cut, perturb, check and publish datasets."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import tyro

from shinypartial.cli.newest import announce_newest
from shinypartial.conversion.layouts import AxisName, CaptureLayout
from shinypartial.core.command_line import command_line
from shinypartial.core.errors import InputError
from shinypartial.dataset.perturb.options import CameraErrors, MaskErrors, Perturbation, SensorErrors, ViewChoice, World


@dataclass(frozen=True)
class Subset:
    """Cut a 360° dataset down to one hemisphere: the cameras near the crossing of their looped path, split again."""

    source: tyro.conf.Positional[Path]
    """Folder in the layout of Shiny Blender (or of NeRF-synthetic); it is only read."""
    output: Path | None = None
    """Folder to write; datasets/NAME-partial when not given."""
    around: tuple[float, float] | None = None
    """Azimuth (from +X toward +Y) and elevation of the middle in degrees; where the path crosses itself by default."""
    radius_deg: float = 90.0
    """Keep the cameras that are seen from the object less than this away from the middle; 90 keeps the hemisphere."""
    seed: int = 0
    """Seed of the new split: 40 % of the kept views for training, 60 % for testing."""
    link: bool = False
    """Make hard links in place of copies."""

    def run(self) -> None:
        """Make the subset and say what was kept."""
        from shinypartial.dataset.read import DEFAULT_FOLDER
        from shinypartial.dataset.subset import SubsetOptions, describe, make_subset

        root = self.output or DEFAULT_FOLDER / f"{self.source.resolve().name}-partial"
        options = SubsetOptions(self.around, self.radius_deg, self.seed)
        made = make_subset(self.source, root, options, link=self.link)
        kept = made.selection
        print(f"Around {describe(kept.axis)}: {len(kept.train)} training and {len(kept.test)} test views,")
        print(f"{len(kept.dropped)} left out, in {made.root}")
        for split in made.without_normals:
            print(f"No normals in {split}: only some of its views had any, and scores need all or none.")
        print("Next:", command_line("panoless", "fit", made.root))


@dataclass(frozen=True)
class FindLight:
    """Recognize the map that lights a dataset without an environment, and copy the dataset with it.

    Blender's eight studio lights are tried in all turns about the vertical. Ground-truth normals are needed.
    """

    source: tyro.conf.Positional[Path]
    """Dataset folder, such as one of Shiny Blender or a subset of it; it is only read."""
    output: Path | None = None
    """Folder to write; datasets/NAME-lit when not given."""
    worlds: tuple[Path, ...] = ()
    """Maps to try in place of Blender's: linear 2:1 EXR files with +Z on top."""
    strength: float = 1.0
    """What the map is multiplied by, as the scene does; 1 is what scenes in Blender begin with."""
    link: bool = False
    """Make hard links in place of copies."""

    def run(self) -> None:
        """Say which map it is, and write the copy."""
        from shinypartial.blender.runtime import studio_light
        from shinypartial.dataset.read import DEFAULT_FOLDER
        from shinypartial.oracle.known_light import find_light
        from shinypartial.scene import STUDIO_LIGHTS

        known = {path.stem: path for path in self.worlds} or {name: studio_light(name) for name in STUDIO_LIGHTS}
        if self.worlds and len(known) < len(self.worlds):
            raise InputError(
                expected="--worlds of different file names, by which maps are distinguished",
                found=", ".join(map(str, self.worlds)),
                remedy="Rename files, or name each map once.",
            )
        root = self.output or DEFAULT_FOLDER / f"{self.source.resolve().name}-lit"
        found = find_light(self.source, root, known, strength=self.strength, link=self.link)
        match = found.match
        print(f"Lit by {match.name}, turned by {match.turn_deg:.2f}° about +Z, of which it shows {2**match.stops:.2f}")
        near = f"; next {found.others[0].name} {found.others[0].correlation:.2f}" if found.others else ""
        print(f"Correlation of details {match.correlation:.2f}{near}")
        print("Next:", command_line("panoless", "fit", found.root))


@dataclass(frozen=True)
class ImportDataset:
    """Make a dataset folder of a capture of a public set of real objects, with its light and its normals.

    Run again to continue where an earlier run stopped.
    """

    layout: tyro.conf.Positional[CaptureLayout]
    """Whose layout the folder has; see docs/how-to/real-objects.md."""
    folder: tyro.conf.Positional[Path]
    """One capture; it is only read."""
    output: Path
    """Folder to write."""
    map_axes: tuple[AxisName, AxisName, AxisName] | None = None
    """What the stored map shows in its middle, right of it and on top, in place of the layout's own: +X -Y +Z. In axes
    of the world, or of the camera where each view has a map."""
    link: bool = False
    """Make hard links in place of copies of files that stay the same."""

    def run(self) -> None:
        """Write the folder and say what is missing."""
        from shinypartial.conversion.captures.make import import_capture, named_axes

        axes = None if self.map_axes is None else named_axes(self.map_axes)
        made = import_capture(self.layout, self.folder, self.output, axes, link=self.link)
        print(f"{self.output}: {made.train} training and {made.test} test views")
        for reason in made.left_out:
            print(f"Left out {reason}")
        print("Next:", command_line("panoless", "fit", self.output))


@dataclass(frozen=True)
class Perturb:
    """Make a worse copy of a dataset: its training views are perturbed, all that is scored against stays true.

    Run again to continue where an earlier run stopped.
    """

    FIRST: ClassVar = (
        "source output seed cameras.rotation_deg cameras.focal_factor masks.erode_px masks.dilate_px sensor.blur_px "
        "sensor.k1 views.keep"
    )
    source: tyro.conf.Positional[Path]
    """Dataset folder, also a plain NeRF-synthetic one, or the name of a bundled one; it is only read."""
    output: Path
    """Folder to write."""
    seed: int = 0
    """Seed of everything that is drawn by chance."""
    link: bool = False
    """Make hard links in place of copies of files that stay the same."""
    cameras: CameraErrors = CameraErrors()
    masks: MaskErrors = MaskErrors()
    sensor: SensorErrors = SensorErrors()
    views: ViewChoice = ViewChoice()
    world: World = World()

    def run(self) -> None:
        """Make the copy and say what to do next."""
        from shinypartial.dataset.bundled import resolve_dataset
        from shinypartial.dataset.perturb.options import changed_options
        from shinypartial.dataset.perturb.worse_copy import perturb

        options = Perturbation(self.cameras, self.masks, self.sensor, self.views, self.world, self.seed)
        made = perturb(resolve_dataset(self.source), self.output, options, link=self.link)
        changes = [
            f"{group}.{name} {value}"
            for group, values in changed_options(options).items()
            for name, value in values.items()
        ]
        print(f"{made.root}: {len(made.plan.views)} training views, {', '.join(changes) or 'nothing changed'}")
        print("Next:", command_line("panoless", "fit", made.root))


@dataclass(frozen=True)
class Align:
    """Move a captured dataset into the world of its truth and say how far its cameras and masks are off.

    The copy has the truth's test cameras, so that a fit of it can be scored against the truth.
    """

    captured: tyro.conf.Positional[Path]
    """Dataset that `panoless capture`, or another program, made of a film; it is only read."""
    truth: Path
    """Folder `truth` of that film."""
    output: Path
    """Folder to write."""
    gauge: Literal["board", "ball", "similarity", "same"] | None = None
    """By the board's known place, which estimates nothing; by a rotation alone, where the captured world is that of a
    ball; by the similarity that brings all poses nearest; or not at all, where cameras are in the truth's world. By the
    board, where the film has one, when not given."""

    def run(self) -> None:
        """Write the copy and say what was measured."""
        from shinypartial.dataset.same_world import align

        made = align(self.captured, self.truth, self.output, self.gauge)
        print(made.summary())
        score = command_line("shinypartial", "evaluate", "--dataset", self.truth)
        print("Next:", command_line("panoless", "fit", self.output) + ", then", score)


@dataclass(frozen=True)
class ExportCameras:
    """Write the cameras of a dataset for other programs: a COLMAP model, or nerfstudio's transforms.json."""

    dataset: tyro.conf.Positional[Path]
    """Dataset folder, also a plain NeRF-synthetic one, or the name of a bundled one; it is only read."""
    output: Path
    """Folder to write; for COLMAP it is the model, such as sparse/0."""
    to: Literal["colmap", "nerf"] = "colmap"
    """Kind of the files."""

    def run(self) -> None:
        """Write the files and name them."""
        from shinypartial.dataset.bundled import resolve_dataset
        from shinypartial.dataset.export_cameras import export_cameras
        from shinypartial.dataset.read import open_dataset

        written = export_cameras(open_dataset(resolve_dataset(self.dataset)), self.output, self.to)
        print("Cameras written to", *written)


@dataclass(frozen=True)
class Validate:
    """Check every promise of the dataset format; list each break with its file and its remedy."""

    folder: tyro.conf.Positional[Path | None] = None
    """Dataset folder, or a release of several; the newest dataset below datasets/ when not given."""

    def run(self) -> None:
        """Print every break; raise InputError when there is one."""
        from shinypartial.dataset.read import newest_dataset
        from shinypartial.dataset.validate import unscored, validate
        from shinypartial.release.release import is_release, validate_release

        folder = self.folder or announce_newest("dataset", newest_dataset())
        violations = (validate_release if is_release(folder) else validate)(folder, progress=True)
        for one in violations:
            print(f"{'warning: ' if one.warning else ''}{one.file}: {one.problem}. {one.remedy}")
        broken = sum(not one.warning for one in violations)
        if broken:
            raise InputError(
                expected=f"every promise of the format kept in {folder}",
                found=f"{broken} broken {'promise' if broken == 1 else 'promises'}, listed above",
                remedy="Follow the remedies, then validate again.",
            )
        print(f"{folder} keeps every promise of the format.")
        lacking = None if is_release(folder) else unscored(folder)
        if lacking:
            print(lacking)


@dataclass(frozen=True)
class Release:
    """Make what is uploaded: data, archives, dataset card, Croissant metadata, licenses and checksums."""

    datasets: tyro.conf.Positional[tuple[Path, ...]]
    """Finished dataset folders."""
    output: Path
    """Folder to write; run again to continue where an earlier run stopped."""
    name: str | None = None
    """Name of the release; that of the output folder when not given."""
    version: str = "1.0.0"
    """MAJOR.MINOR.PATCH."""
    date: str | None = None
    """Date of publication, YYYY-MM-DD; the day on which the release was begun when not given."""
    creator: str = "The panoless contributors"
    """Who publishes the release, for its metadata and citation."""
    url: str | None = None
    """Where the release will be found."""
    archive: Literal["tar", "tar.gz"] = "tar"
    """Kind of the archives; images are compressed already, so tar.gz saves little."""

    def run(self) -> None:
        """Make the release and say what to do next."""
        import datetime

        from shinypartial.release.publication import Publication
        from shinypartial.release.release import recorded_date, release

        date = self.date or recorded_date(self.output) or datetime.datetime.now(datetime.UTC).date().isoformat()
        name = self.name or self.output.resolve().name
        publication = Publication(name, self.version, date, self.creator, self.url)
        made = release(self.datasets, self.output, publication, f".{self.archive}", progress=True)
        kept = f" ({made.kept} of the files were there already)" if made.kept else ""
        print(f"Release: {made.root}{kept}")
        print(f"Next: read {made.root / 'README.md'}, then upload the folder as it is")
