"""Which of some known environment maps lights the object of a dataset, and how that map is turned about the vertical.

Public sets of rendered objects were lit by maps that are known, but come without them. With ground-truth normals the
photographs determine the map well enough to recognize it, and then environments can be scored there, too. No prediction
is looked at.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Complex, Float

from shinypartial.core.camera import ray_directions_world, reflect
from shinypartial.core.color import linear_to_srgb
from shinypartial.core.conventions import FACES
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import (
    blur_latlong,
    directions_to_latlong,
    latlong_directions,
    latlong_solid_angles,
    sample_latlong,
)
from shinypartial.dataset.camera_plot import CAMERA_PLOT
from shinypartial.dataset.derived import Job, licenses_of, open_source, place_of, write_derived
from shinypartial.dataset.perturb.turned import Turn, turned_latlong
from shinypartial.dataset.read import read_view
from shinypartial.dataset.schema import (
    ENVIRONMENT_CUBE,
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    SPLITS,
    Dataset,
    Frame,
)
from shinypartial.dataset.subset import all_files_of
from shinypartial.dataset.write import write_environment
from shinypartial.evaluation.masks import environment_mask
from shinypartial.io.files import sha256_of
from shinypartial.io.images import read_light
from shinypartial.io.progress import Progress

ENVIRONMENT_FILES = (
    ENVIRONMENT_LATLONG,
    ENVIRONMENT_LATLONG_Y_UP,
    *(ENVIRONMENT_CUBE / f"{name}.exr" for name in FACES),
)
BRIGHTNESS_REACH = 5.0
"""By so many stops the brightness may be another than the one with the highest correlation."""
MOST_VIEWS = 40
"""Views that determine the light, evenly spread over those that have normals."""
HEIGHT = 64
"""Rows of the maps in which all turns are compared."""
DETAIL_RAD = 0.1
"""Details are what a Gaussian of this standard deviation takes away: broad light is alike in many worlds."""
STOPS = tuple(range(-4, 5))
"""Brightness of a map that is tried, as powers of 2."""
RAYS = 30_000
"""Mirrored rays that determine the exact turn and brightness."""
LEAST_CORRELATION = 0.6
"""Of the details that a map has and those that were photographed; below it no map is taken."""
LEAST_LEAD = 0.2
"""By which the correlation of the best map is above that of every other."""


@dataclass(frozen=True)
class Match:
    """A map as it fits best: turned counterclockwise about +Z, seen from above; 2^stops of its light are shown."""

    name: str
    turn_deg: float
    stops: float
    correlation: float
    """Of details in sRGB codes, over the directions that are seen, all channels together."""


@dataclass(frozen=True)
class Seen:
    """Mirrored rays of some views: unit world directions and sRGB codes in [0, 1]."""

    directions: Float[np.ndarray, "P 3"]
    codes: Float[np.ndarray, "P 3"]


@dataclass(frozen=True)
class LitDataset:
    """What was found and written."""

    root: Path
    match: Match
    others: tuple[Match, ...]
    """The other maps, best first."""


def find_light(
    source: Path,
    root: Path,
    worlds: Mapping[str, Path],
    *,
    strength: float = 1.0,
    link: bool = False,
) -> LitDataset:
    """Copy a dataset to `root` with the map of `worlds` (name to linear 2:1 EXR) that lights it as its environment.

    The map is multiplied by `strength`, which photographs of anything but a mirror don't determine. Raises InputError
    where the dataset has an environment or no normals, or pictures outside of its folder, or where no map is clearly
    the one.
    """
    dataset = open_source(source, root)
    if (dataset.root / ENVIRONMENT_LATLONG).exists():
        raise InputError(
            expected=f"a dataset without {ENVIRONMENT_LATLONG}",
            found=f"{dataset.root / ENVIRONMENT_LATLONG}",
            remedy="Score against it: its light is known already.",
        )
    if not (np.isfinite(strength) and strength > 0):
        raise InputError(
            expected="a --strength above 0", found=f"{strength}", remedy="Give what the scene multiplies its map by."
        )
    files = [path for split in SPLITS for frame in dataset.split(split) for path in all_files_of(frame)]
    transforms = [path for split in SPLITS if (path := dataset.root / f"transforms_{split}.json").exists()]
    plot = dataset.root / CAMERA_PLOT
    copies = [*files, *transforms, *([plot] if plot.exists() else [])]
    jobs = [Job.copy(old, place_of(old, dataset, root), link) for old in dict.fromkeys(copies)]
    maps = {name: read_light(path) for name, path in worlds.items()}
    matches = match_worlds(mirrored_rays(dataset), maps)
    match = clear_winner(matches)
    world = turned_latlong(maps[match.name], _about_z(match.turn_deg)) * np.float32(strength)
    jobs.append(Job(tuple(root / each for each in ENVIRONMENT_FILES), lambda: write_environment(root, world)))
    recipe = {
        "hemisphere_axis": None,
        **dataset.recipe,
        "lit_copy_of": {"name": dataset.name, **{path.name: sha256_of(path) for path in transforms}},
        "light": {"name": match.name, "sha256": sha256_of(worlds[match.name]), "strength": strength},
    }
    asset = {"asset": f"environment {match.name}", "license": "that of the map", "source": worlds[match.name].name}
    statistics = {**dataset.statistics, "lights_tried": [asdict(each) for each in matches]}
    write_derived(root, [*licenses_of(dataset), asset], recipe, jobs, "Copying", lambda: statistics)
    return LitDataset(root, match, tuple(each for each in matches if each is not match))


def mirrored_rays(dataset: Dataset) -> Seen:
    """Where pixels that lie wholly on the object mirror to by ground-truth normals, in views of both splits."""
    frames = [frame for split in SPLITS for frame in dataset.split(split) if _normals_known(frame)]
    frames = frames[:: max(1, -(-len(frames) // MOST_VIEWS))]
    parts, progress = [], Progress("reading views", len(frames))
    for frame in frames:
        view = read_view(frame)
        if view.normals_world is not None:
            mask = environment_mask(view)
            directions = reflect(ray_directions_world(frame.camera), view.normals_world.astype(np.float64))
            parts.append((directions[mask], linear_to_srgb(np.clip(view.radiance[mask], 0, 1))))
        progress.advance()
    if not sum(len(part) for part, _ in parts):
        raise InputError(
            expected=f"ground-truth normals in some views of {dataset.root}",
            found="none",
            remedy="The light of photographs without normals can't be determined.",
        )
    directions, codes = (np.concatenate(each).astype(np.float64) for each in zip(*parts, strict=True))
    return Seen(directions, codes)


def _normals_known(frame: Frame) -> bool:
    return frame.normal_png.exists() or frame.exr.exists()


def match_worlds(seen: Seen, worlds: Mapping[str, Float[np.ndarray, "H W 3"]]) -> tuple[Match, ...]:
    """How well the details of each map are those that were seen, best first; the best one's turn is made exact.

    All turns by whole columns are compared at once, as circular correlations of rows.
    """
    weight, details = _seen_details(seen)
    progress, found = Progress("comparing lights", len(worlds)), []
    for name, world in worlds.items():
        turns = _best_turns(name, weight, details, _shrunk(world, HEIGHT))
        found.append(max(turns, key=lambda each: each.correlation))
        progress.advance()
    best, *others = sorted(found, key=lambda each: -each.correlation)
    return _exact(best, _evenly(seen, RAYS), worlds[best.name], 360 / (2 * HEIGHT)), *others


def clear_winner(matches: Iterable[Match]) -> Match:
    """The best match; InputError where it is not good enough, or not clearly better than the others."""
    best, *others = matches
    lead = best.correlation - max((each.correlation for each in others), default=0.0)
    if best.correlation < LEAST_CORRELATION or lead < LEAST_LEAD:
        near = ", ".join(f"{each.name} {each.correlation:.2f}" for each in (best, *others[:2]))
        raise InputError(
            expected=f"one map whose details correlate with what is mirrored by {LEAST_CORRELATION:g} or more, "
            f"and by {LEAST_LEAD:g} more than those of any other",
            found=near,
            remedy="Name more maps by --worlds: none of these lights the object, or it is too rough to recognize one.",
        )
    return best


def _about_z(turn_deg: float) -> Turn:
    """Counterclockwise, seen from above."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()


def _seen_details(seen: Seen) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """The solid angle of texels that rays fall into, 0 of the others, and the details of their mean codes."""
    height, width = HEIGHT, 2 * HEIGHT
    uv = directions_to_latlong(seen.directions)
    row = np.minimum((uv[:, 1] * height).astype(int), height - 1)
    flat = row * width + (uv[:, 0] * width).astype(int) % width
    count = np.bincount(flat, minlength=height * width)
    sums = np.stack([np.bincount(flat, channel, minlength=height * width) for channel in seen.codes.T], -1)
    codes = (sums / np.maximum(count, 1)[:, None]).reshape(height, width, 3)
    known = (count > 0).reshape(height, width, 1).astype(float)
    blurred = blur_latlong(np.concatenate([codes, known], -1), DETAIL_RAD)
    details = known * (codes - blurred[..., :3] / np.maximum(blurred[..., 3:], 1e-6))
    return latlong_solid_angles(height) * known[..., 0], details


def _shrunk(world: Float[np.ndarray, "H W 3"], height: int) -> Float[np.ndarray, "h w 3"]:
    """The mean radiance over texels of a coarser map, or what a finer one has at its texels."""
    factor = max(1, world.shape[0] // height)
    samples = sample_latlong(world, latlong_directions(height * factor))
    return samples.reshape(height, factor, 2 * height, factor, 3).mean((1, 3))


def _best_turns(
    name: str,
    weight: Float[np.ndarray, "H W"],
    details: Float[np.ndarray, "H W 3"],
    world: Float[np.ndarray, "H W 3"],
) -> Iterator[Match]:
    """For each brightness the turn with the highest correlation."""
    width = weight.shape[1]
    of_weight = np.fft.rfft(weight, axis=1)[..., None]
    of_seen = np.fft.rfft(weight[..., None] * details, axis=1)
    power = float((weight[..., None] * details**2).sum())
    for stops in STOPS:
        codes = linear_to_srgb(np.clip(world * 2.0**stops, 0, 1))
        own = codes - blur_latlong(codes, DETAIL_RAD)
        both = _over_turns(of_seen, np.fft.rfft(own, axis=1), width)
        powers = power * _over_turns(of_weight, np.fft.rfft(own**2, axis=1), width)
        correlation = both / np.sqrt(np.maximum(powers, 1e-12))
        best = int(correlation.argmax())
        yield Match(name, 360 * best / width, float(stops), float(correlation[best]))


def _over_turns(
    first: Complex[np.ndarray, "H F _"], second: Complex[np.ndarray, "H F 3"], width: int
) -> Float[np.ndarray, " W"]:
    """Σ a(u) b(u + k) for all shifts k, of what rows became by Fourier transforms."""
    return np.fft.irfft((np.conj(first) * second).sum(axis=(0, 2)), n=width)


def _evenly(seen: Seen, count: int) -> Seen:
    step = -(-len(seen.directions) // count)
    return Seen(seen.directions[::step], seen.codes[::step])


def _lowest(measure: Callable[[float], float], middle: float, reach: float) -> float:
    """Where a function has its lowest value near a place."""
    from scipy.optimize import minimize_scalar

    return float(minimize_scalar(measure, bounds=(middle - reach, middle + reach), method="bounded").x)


def _exact(match: Match, seen: Seen, world: Float[np.ndarray, "H W 3"], column_deg: float) -> Match:
    """With the brightness, and then the turn within a column, at which rays differ least from the map, both twice.

    Rays that see something else, such as the object itself, bend neither: differences are absolute ones.
    """

    def shown(turn_deg: float, stops: float) -> Float[np.ndarray, "P 3"]:
        unturned = sample_latlong(world, seen.directions @ _about_z(turn_deg))
        return linear_to_srgb(np.clip(unturned * 2.0**stops, 0, 1))

    def unlike(turn_deg: float, stops: float) -> float:
        return float(np.abs(shown(turn_deg, stops) - seen.codes).mean())

    turn, stops = match.turn_deg, match.stops
    # Correlations hardly determine the brightness, so it is sought among all of them first.
    for columns, reach in ((1.0, BRIGHTNESS_REACH), (0.5, 1.0)):
        stops = _lowest(partial(unlike, turn), stops, reach)
        turn = _lowest(partial(unlike, stops=stops), turn, columns * column_deg)
    return replace(match, turn_deg=(turn + 180) % 360 - 180, stops=stops)
