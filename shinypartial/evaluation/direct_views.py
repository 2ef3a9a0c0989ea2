"""A prediction of what a ball mirrors, against what photographs from its other side show directly, past the ball."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from shinypartial.core.color import to_display
from shinypartial.core.errors import InputError
from shinypartial.core.sphere import latlong_directions, sample_latlong
from shinypartial.dataset.read import open_dataset, read_ball_evidence, read_whole_view
from shinypartial.dataset.schema import Frame
from shinypartial.io.files import write_json
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.io.records import write_record
from shinypartial.metrics.angular import angular_error_deg
from shinypartial.metrics.direct_views import (
    REACH,
    DirectScores,
    DirectView,
    direct_panorama,
    direct_scores,
    direct_view,
    gain_between,
    lamp_directions,
    seen_from_origin,
    with_margin,
)
from shinypartial.metrics.registry import metric
from shinypartial.prediction.format import read_environment_map, read_info, read_inverse_distance

DIRECT_SCORES, DIRECT_PICTURE = "direct_views.json", "direct_views.jpg"
DISTANCES = (1e6, 400.0, 200.0, 100.0, 50.0)
"""D in radii of the ball, of which each view takes that of the least offset where the prediction states no distance."""
CHANCE_TURNS_DEG = (90, 180, 270)
"""Turns of the map about the vertical; chance is the median over all of them."""
PANORAMA_HEIGHT = 180
PICTURED, TILE_PX = 3, (400, 300)
FIGURES = ("correlation", "correlation_unfiltered", "psnr_srgb", "psnr_linear", "offset_deg", "across_deg")


@dataclass(frozen=True)
class DirectEvaluation:
    """Of a prediction against direct views; `view_scores` are those of `views`, in order."""

    views: tuple[str, ...]
    median: DirectScores
    chance: DirectScores
    """The same medians, over turns of the map about the vertical."""
    view_scores: tuple[DirectScores, ...]
    gain: tuple[float, float, float]
    """Of seen over predicted linear light, red, green and blue: one for all views."""
    distances_radii: tuple[float, ...] | None
    """Of the surroundings in each view, where the prediction states none: those of the least offset."""
    lamps: int
    """That are seen directly and at least half as bright as the brightest: where clipped, nothing says which is."""
    lamp_error_deg: float | None
    """From the map's brightest direction, among those above the ball seen directly, to the nearest of these lamps."""
    lamp_chance_deg: float | None

    def lines(self) -> list[str]:
        """A table: what was found beside chance."""
        lines = [f"{'':44s}{'median':>10s}{'chance':>10s}"]
        for name in FIGURES:
            row = metric(name if name.startswith("psnr") else f"direct_{name}")
            values = (row.text(getattr(each, name)) for each in (self.median, self.chance))
            lines.append(f"{row.title:44s}" + "".join(f"{value:>10s}" for value in values))
        lamp = metric("lamp_error_deg")
        values = (lamp.text(each) for each in (self.lamp_error_deg, self.lamp_chance_deg))
        lines.append(f"{lamp.title:44s}" + "".join(f"{value:>10s}" for value in values))
        return lines


@dataclass(frozen=True)
class _Rendered:
    """The map as each view would see it, with REACH cells of margin, and how it compares after the gain."""

    pictures: list[Float[np.ndarray, "_ _ 3"]]
    gain: Float[np.ndarray, "3"]
    scores: list[DirectScores]


def evaluate_direct(prediction: Path, dataset: Path, hold_out: Sequence[str] = ()) -> DirectEvaluation:
    """Compare a prediction with what other cameras of its capture see beside the ball; write both files into it.

    `dataset` is one about a ball of radius 1 at the origin, in the world of the prediction. `hold_out` names its
    cameras to compare with; without it these are all that the prediction doesn't list among its own. Raises InputError
    where none remains, for a name that isn't there, and for a dataset of something else.
    """
    environment = read_environment_map(prediction).astype(np.float64)
    frames = _held_out(prediction, dataset, hold_out)
    views = [direct_view(frame.camera, read_whole_view(frame)[1]) for frame in frames]
    names = tuple(frame.stem.name for frame in frames)
    covered = [name for name, view in zip(names, views, strict=True) if not view.shown.any()]
    if covered:
        raise InputError(
            expected="views that show surroundings beside the ball and what it stands on",
            found=f"none in {covered[0]}",
            remedy="Name others: --hold-out NAMES.",
        )
    found, pictures = compare_direct(names, views, environment, read_inverse_distance(prediction))
    write_json(prediction / DIRECT_SCORES, write_record(found))
    chosen = sorted({round(each) for each in np.linspace(0, len(names) - 1, PICTURED)})
    direct = {f"{names[i]}: seen directly": _dimmed(views[i].radiance, views[i]) for i in chosen}
    of_map = {f"{names[i]}: the map": _dimmed(pictures[i], views[i]) for i in chosen}
    write_picture_sheet(
        prediction / DIRECT_PICTURE, direct | of_map, widths=(TILE_PX[0],) * len(chosen), height=TILE_PX[1]
    )
    return found


def compare_direct(
    names: Sequence[str],
    views: Sequence[DirectView],
    environment: Float[np.ndarray, "H W 3"],
    inverse_distance: Float[np.ndarray, "h w"] | None,
) -> tuple[DirectEvaluation, list[Float[np.ndarray, "_ _ 3"]]]:
    """The scores, and what the map has in each view's cells, after the gain; of arrays, without files."""
    if inverse_distance is None:
        distances = tuple(_distance(view, environment) for view in views)
        inverses = [np.full((2, 4), 1 / each) for each in distances]
    else:
        distances, inverses = None, [inverse_distance] * len(views)
    parts = list(zip(views, inverses, strict=True))
    directions = [seen_from_origin(with_margin(view.camera, REACH), inverse) for view, inverse in parts]
    found = _rendered(views, environment, directions)
    turned = [
        score
        for turn in CHANCE_TURNS_DEG
        for score in _rendered(views, environment, directions, np.radians(turn)).scores
    ]
    panorama, known = direct_panorama(views, inverses, PANORAMA_HEIGHT)
    known &= latlong_directions(PANORAMA_HEIGHT)[..., 2] > 0  # Below, what is near glitters from one side.
    lamps = lamp_directions(panorama, known)
    errors = [_lamp_error(environment * found.gain, np.radians(turn), lamps, known) for turn in (0, *CHANCE_TURNS_DEG)]
    chances = [each for each in errors[1:] if each is not None]
    red, green, blue = map(float, found.gain)
    evaluation = DirectEvaluation(
        views=tuple(names),
        median=_median(found.scores),
        chance=_median(turned),
        view_scores=tuple(found.scores),
        gain=(red, green, blue),
        distances_radii=distances,
        lamps=len(lamps),
        lamp_error_deg=errors[0],
        lamp_chance_deg=float(np.median(chances)) if chances else None,
    )
    inner = slice(REACH, -REACH)
    return evaluation, [picture[inner, inner] * found.gain for picture in found.pictures]


def _distance(view: DirectView, environment: Float[np.ndarray, "H W 3"]) -> float:
    """Of DISTANCES, the one at which features are least off; the first where no feature shows one."""
    offsets = []
    for distance in DISTANCES:
        directions = seen_from_origin(with_margin(view.camera, REACH), np.full((2, 4), 1 / distance))
        offset = direct_scores(view, sample_latlong(environment, directions), directions, np.ones(3)).offset_deg
        offsets.append(np.inf if offset is None else offset)
    return DISTANCES[int(np.argmin(offsets))]


def _rendered(
    views: Sequence[DirectView],
    environment: Float[np.ndarray, "H W 3"],
    directions: Sequence[Float[np.ndarray, "_ _ 3"]],
    turn: float = 0.0,
) -> _Rendered:
    """Of the map turned about +Z by an angle (rad)."""
    pictures = [sample_latlong(environment, each @ _turn(turn)) for each in directions]
    inner = slice(REACH, -REACH)
    gain = gain_between(views, [picture[inner, inner] for picture in pictures])
    parts = zip(views, pictures, directions, strict=True)
    return _Rendered(pictures, gain, [direct_scores(view, picture, each, gain) for view, picture, each in parts])


def _turn(angle: float) -> Float[np.ndarray, "3 3"]:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _lamp_error(
    environment: Float[np.ndarray, "H W 3"],
    turn: float,
    lamps: Float[np.ndarray, "N 3"],
    known: Bool[np.ndarray, "h w"],
) -> float | None:
    """From the brightest lamp of a map turned about +Z to the nearest of these; None where there is none."""
    own = lamp_directions(sample_latlong(environment, latlong_directions(len(known)) @ _turn(turn)), known)
    return float(angular_error_deg(lamps, own[:1]).min()) if len(lamps) and len(own) else None


def _median(scores: Sequence[DirectScores]) -> DirectScores:
    found: dict[str, float | None] = {}
    for name in FIGURES:
        known = [value for each in scores if (value := getattr(each, name)) is not None]
        found[name] = float(np.median(known)) if known else None
    return DirectScores(**found, windows=sum(each.windows for each in scores))  # type: ignore[arg-type]


def _held_out(prediction: Path, root: Path, hold_out: Sequence[str]) -> list[Frame]:
    dataset = open_dataset(root)
    if read_ball_evidence(dataset) is None:
        raise InputError(
            expected=f"a dataset of a mirror ball at {root}, of radius 1 about the origin",
            found="no `ball` in its transforms_train.json",
            remedy="Make one of all photographs: `panoless capture PHOTO… --object ball`.",
        )
    frames = {frame.stem.name: frame for frame in dataset.train}
    own = {Path(each.name).name for each in read_info(prediction).cameras or ()}
    missing = [name for name in hold_out if name not in frames]
    if missing:
        raise InputError(
            expected=f"--hold-out with names of views of {root}, such as {next(iter(frames))}",
            found=missing[0],
            remedy="Correct that name.",
        )
    kept = list(hold_out) or [name for name in frames if own and name not in own]
    if not kept:
        raise InputError(
            expected=f"views of {root} that {prediction} was not fitted to",
            found="none: it " + ("has them all" if own else "lists no cameras"),
            remedy="Fit a part of the capture, or name views: --hold-out NAMES.",
        )
    return [frames[name] for name in kept]


def _dimmed(radiance: Float[np.ndarray, "H W 3"], view: DirectView) -> UInt8[np.ndarray, "H W 3"]:
    """As a picture; cells that don't count at a fifth of their light."""
    return to_display(radiance * np.where(view.shown, 1, 0.2)[..., None])
