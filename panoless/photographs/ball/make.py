"""Photographs of a mirror ball to a dataset folder: one to fifty of them, without masks and without poses.

The ball has radius 1 and its center is the world's origin; +Z is up as far as cameras were held level, and the first
camera stands at −Y.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from panoless.numeric.robust import bounded_error, robust_scale
from panoless.photographs.ball.adjust import cone_of
from panoless.photographs.ball.background import FARTHEST, write_background
from panoless.photographs.ball.beside import PosedBall, agreement, log_light, refraction_agreement
from panoless.photographs.ball.brackets import Exposed, exposed, same_pose
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.find import FoundBall, find_balls, hidden
from panoless.photographs.ball.poses import PosedBalls, posed_balls
from panoless.photographs.lens import Lens
from panoless.photographs.make import check_output
from panoless.photographs.masks import Hint
from panoless.photographs.models import read_rotations
from panoless.photographs.shot import Focal, Shot
from shinypartial.core.conventions import HIDDEN_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import BACKGROUND, BallEvidence, Frame
from shinypartial.dataset.write import write_transforms
from shinypartial.io.files import folder_lock
from shinypartial.io.images import write_exr_rgb, write_png
from shinypartial.io.threads import in_threads

REFRACTED = 0.35
"""Correlation with what glass would show, above which a ball is one of glass."""
LEAST_RING = 0.25
"""Correlation of what lies beside a ball with what its rim mirrors, below which a single photograph is refused: 0.37 in
nineteen of twenty photographs of a lobby, 0.19 at most of cups, coins, clocks and eyes."""
RIM_CORRELATION = 20
"""Neighboring points of a rim are off alike: one in so many is news."""
ROOM = 2.5
"""Radii from the ball's middle within which its mask lies: beside the middle of a picture it is an oval, up to twice as
wide at 45°."""
FOCAL_LOGS = np.linspace(-0.3, 0.3, 13)
"""Logarithms of focal lengths over that stated, at which ovals are tested."""


@dataclass(frozen=True)
class BallRequest:
    """Which photographs, and what a person says of them."""

    files: tuple[Path, ...]
    output: Path
    focal_film_mm: float | None = None
    """Focal length on 35 mm film; None for what EXIF says."""
    hints: Mapping[str, Hint] = field(default_factory=dict)
    found: Mapping[Path, FoundBall] = field(default_factory=dict)
    """Balls that were looked for before."""
    background: bool = False
    """Whether what lies past the ball is data for the map, too."""
    model: Path | None = None
    """Folder of a COLMAP model of these photographs, whose rotations are compared with those by reflections."""


@dataclass(frozen=True)
class CapturedBall:
    """What was made."""

    output: Path
    frames: tuple[str, ...]
    left_out: tuple[str, ...]
    focal: Focal
    evidence: BallEvidence
    brackets: int
    high_dynamic_range: bool
    rivals: int
    """Photographs that show a second circle as clear."""
    walls_radii: float
    """Distance of the surroundings at which direct and mirrored views agree best; infinite where none does."""
    compared: str = ""
    """What rotations of a COLMAP model explain, in one line."""

    def summary(self) -> list[str]:
        """What was found, a line each."""
        found, evidence = len(self.frames), self.evidence
        joined = f", of {self.brackets} exposures merged" if self.brackets > found else ""
        lines = [
            f"Ball: in {found} photographs{joined}; its rim to {evidence.rim_px:.2f} px, {evidence.rim_seen:.0%} seen",
            f"Lens: {self.focal.film_mm:.0f} mm on 35 mm film ± {evidence.focal_sigma:.0%}, from {self.focal.origin}",
        ]
        if found > 1:
            lines.append(
                f"Poses: by what the ball mirrors, to {evidence.turn_deg:.2g}°; reflections agree to "
                f"{evidence.reflection_deg:.2g}°"
            )
        if self.compared:
            lines.append(self.compared)
        if evidence.agreement is not None:
            lines.append(
                f"Check: what lies beside the ball correlates with what it mirrors by {evidence.agreement:.2f}"
                + (f", best for walls at {self.walls_radii:.0f} of its radii" if self.walls_radii < FARTHEST else "")
            )
        if 2 * self.rivals >= found:
            lines.append("Note: a second ball, or something as round, shows. The larger was taken; --clicks chooses.")
        if self.left_out:
            lines.append(f"Left out, as their reflections agree with no other: {', '.join(self.left_out)}")
        if self.high_dynamic_range:
            lines.append("Light: linear, exposures equalized; fit it with --config.environment.range hdr")
        return lines


def capture_ball(request: BallRequest) -> CapturedBall:
    """Make the dataset folder of photographs of one ball.

    Raises InputError where no ball is found, where it is cut or blurred or of glass, where reflections of most
    photographs don't agree, and for an output folder that holds other things.
    """
    check_output(request.output)
    with folder_lock(request.output):
        shutil.rmtree(request.output / "train", ignore_errors=True)
        for name in ("transforms_train.json", BACKGROUND):
            (request.output / name).unlink(missing_ok=True)
        return _captured(request)


def _captured(request: BallRequest) -> CapturedBall:
    sheet = request.output / "capture" / "ball.jpg"
    balls = find_balls(request.files, request.hints, request.focal_film_mm, sheet, request.found)
    focal = _focal(balls, request)
    # Of a bracket, the exposure whose rim is seen best stands for all.
    groups = same_pose([ball.shot for ball in balls])
    chosen = [balls[max(group, key=lambda i: balls[i].rim.seen.mean())] for group in groups]
    stated = {} if request.model is None else read_rotations(request.model, [ball.shot.source for ball in chosen])
    by_number = {i: stated[ball.shot.source] for i, ball in enumerate(chosen) if ball.shot.source in stated}
    posed = posed_balls(chosen, [ball.lens(focal) for ball in chosen], by_number)
    members, adjusted = posed.members, posed.adjusted
    if 2 * len(members) < len(chosen) or (len(chosen) > 1 and len(members) < 2):
        raise InputError(
            expected="photographs of one ball in one place, whose reflections agree",
            found=f"{len(posed.left_out)} of {len(chosen)} that agree with no other, such as {posed.left_out[0]}",
            remedy="Leave out photographs of another ball or room, of one that is no mirror, or that were taken after "
            "it was moved; one photograph alone is fitted, too.",
        )
    world = _world(adjusted.rotations, adjusted.cones)
    turned = {i: rotation @ world.T for i, rotation in adjusted.rotations.items()}
    beside = [
        PosedBall(log_light(posed.balls[i].shot.codes()), posed.lenses[i], adjusted.cones[i], turned[i])
        for i in members
    ]
    _refuse_glass(beside, [posed.balls[i].name for i in members])
    shots = [[balls[k].shot for k in groups[i]] for i in members]
    light = exposed(shots)

    def write(view: tuple[int, Exposed]) -> Frame:
        i, each = view
        covariance = _turned_covariance(adjusted.covariance[i], world) if len(members) > 1 else None
        camera = posed.lenses[i], adjusted.cones[i], turned[i]
        return _write_view(posed.balls[i], *camera, covariance, each, request.output / "train")

    frames = list(in_threads(write, zip(members, light, strict=True)))
    agreed, distance = agreement(beside)
    evidence = _evidence(posed, focal, agreed, request.background)
    if request.background:
        linear = [_linear(*each) for each in zip(shots, light, strict=True)]
        write_background(request.output / BACKGROUND, beside, linear, distance)
    if len(members) == 1 and not request.hints and agreed < LEAST_RING:
        raise InputError(
            expected=f"a polished ball in {posed.balls[0].name}, whose rim mirrors what lies beside it",
            found=f"something round: both correlate by {agreed:.2f}",
            remedy="See capture/ball.jpg. Name a point on the ball by --clicks, or add photographs from other sides.",
        )
    write_transforms(request.output, "train", frames, ball=evidence)
    names = tuple(posed.balls[i].name for i in members)
    hdr = any(each.high_dynamic_range for each in light)
    rivals = 0 if request.hints else sum(posed.balls[i].has_rival for i in members)
    exposures, compared = sum(map(len, shots)), _compared(posed, request.model)
    return CapturedBall(
        request.output, names, posed.left_out, focal, evidence, exposures, hdr, rivals, distance, compared
    )


def _compared(posed: PosedBalls, model: Path | None) -> str:
    if model is None or len(posed.members) < 2:
        return ""
    if posed.stated_unexplained is None:
        return f"Compared: {model} has not all of these photographs; poses are by reflections"
    kept = "kept" if posed.by_stated else "not kept"
    return (
        f"Compared: by rotations of {model}, {1 - posed.stated_unexplained:.0%} of reflections agree; they are {kept}"
    )


def _linear(shots: Sequence[Shot], light: Exposed) -> Float[np.ndarray, "H W 3"]:
    """Of a view, NaN where it is clipped."""
    radiance = shots[0].radiance() if light.radiance is None else light.radiance
    clipped = (radiance >= shots[0].clips_at).any(-1) if light.radiance is None else light.unknown
    return np.where(clipped[..., None], np.nan, radiance).astype(np.float32)


def _evidence(posed: PosedBalls, focal: Focal, agreed: float, background: bool) -> BallEvidence:
    adjusted, several = posed.adjusted, len(posed.members) > 1
    turns = [np.degrees(np.sqrt(np.trace(each[:3, :3]))) for each in adjusted.covariance.values()]
    return BallEvidence(
        rim_px=posed.rim_px(),
        rim_seen=float(np.median([posed.balls[i].rim.seen.mean() for i in posed.members])),
        focal_sigma=focal.sigma,
        reflection_deg=adjusted.residual_deg if several else 0.0,
        turn_deg=float(np.median(turns)) if several else 0.0,
        agreement=None if np.isnan(agreed) else agreed,
        exposures_known=all(ball.shot.exposure is not None for ball in posed.balls),
        background=background,
    )


def _focal(balls: Sequence[FoundBall], request: BallRequest) -> Focal:
    """The median of what is stated, and what the ovals of balls off the axis say of it.

    The cones' residuals are minimized over ln f, under the prior of what is stated.
    """
    stated = sorted((ball.focal for ball in balls), key=lambda each: each.over_diagonal)[len(balls) // 2]
    if request.focal_film_mm is not None:
        return stated
    logs, costs = FOCAL_LOGS, []
    for trial in logs:
        moved = replace(stated, over_diagonal=stated.over_diagonal * float(np.exp(trial)))
        of_balls = [cone_of(ball.rim.points, ball.lens(moved))[1] for ball in balls]
        costs.append([_cost(off) for off in of_balls])
    total = np.array(costs).sum(1) + (logs / stated.sigma) ** 2 / 2
    best = int(np.clip(total.argmin(), 1, len(logs) - 2))
    step = logs[1] - logs[0]
    bend = (total[best - 1] - 2 * total[best] + total[best + 1]) / step**2
    slope = (total[best + 1] - total[best - 1]) / (2 * step)
    log = float(np.clip(logs[best] - slope / max(bend, 1e-9), -0.3, 0.3))
    sigma = float(1 / np.sqrt(max(bend, 1e-9)))
    by_ovals = "" if sigma > 0.7 * stated.sigma else ", and the oval of the ball off the axis"
    return Focal(stated.over_diagonal * float(np.exp(log)), min(sigma, stated.sigma), stated.origin + by_ovals)


def _cost(off_px: Float[np.ndarray, "K"]) -> float:
    """Of a rim's distances from its cone, neighbors of which are no news: some count once."""
    scale = robust_scale(off_px, 0.2, 1.5)
    return float(bounded_error(off_px, 2 * scale).sum() * 4 / RIM_CORRELATION / 2)


def _refuse_glass(lights: Sequence[PosedBall], names: Sequence[str]) -> None:
    bent = [refraction_agreement(each) for each in lights[:: -(-len(lights) // 5)]]
    known = [each for each in bent if not np.isnan(each)]
    if known and float(np.median(known)) > REFRACTED:
        raise InputError(
            expected="a ball that mirrors its surroundings",
            found=f"one that shows what lies behind it upside down, as glass does, in {names[0]}",
            remedy="Photograph a ball of chrome or steel.",
        )


def _world(
    rotations: Mapping[int, Float[np.ndarray, "3 3"]], cones: Mapping[int, BallCone]
) -> Float[np.ndarray, "3 3"]:
    """Rows: the axes of the world in the frame of the rotations."""
    from panoless.environment.nearness import upward

    stacked = np.stack([rotations[i] for i in sorted(rotations)])
    up = upward(stacked[:, 0], -stacked[:, 1])
    first = min(rotations)
    toward = -rotations[first].T @ cones[first].axis
    front = -(toward - (toward @ up) * up)
    if np.linalg.norm(front) < 1e-3:
        front = rotations[first][1] - (rotations[first][1] @ up) * up
    front /= np.linalg.norm(front)
    return np.stack([np.cross(front, up), front, up])


def _turned_covariance(
    covariance: Float[np.ndarray, "6 6"], world: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "6 6"]:
    both = np.kron(np.eye(2), world)
    turned: np.ndarray = both @ covariance @ both.T
    return (turned + turned.T) / 2


def coverage(cone: BallCone, lens: Lens) -> Float[np.ndarray, "H W"]:
    """Share of each pixel that the ball covers, by its center's distance from the rim."""
    covered = np.zeros((lens.height, lens.width))
    middle, reach = lens.project(cone.axis), ROOM * lens.fx * np.tan(cone.half_angle)
    left, top = np.clip(np.floor(middle - reach), 0, covered.shape[::-1]).astype(int)
    past_right, past_bottom = np.clip(np.ceil(middle + reach), 0, covered.shape[::-1]).astype(int)
    right, down = np.meshgrid(np.arange(left, past_right) + 0.5, np.arange(top, past_bottom) + 0.5)
    rays = lens.rays(np.stack([right, down], -1))
    angle = np.arccos(np.clip(rays @ cone.axis, -1, 1))
    scale = lens.fx / np.maximum(rays[..., 2], 1e-3)
    covered[top:past_bottom, left:past_right] = np.clip(0.5 - (angle - cone.half_angle) * scale, 0, 1)
    return covered


def _write_view(
    ball: FoundBall,
    lens: Lens,
    cone: BallCone,
    rotation: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "6 6"] | None,
    light: Exposed,
    folder: Path,
) -> Frame:
    """Picture and mask; what is hidden or clipped has an alpha that counts as the object but shows nothing."""
    stem, suffix = folder / ball.name, ".exr" if light.high_dynamic_range else ".png"
    picture, mask_file = folder / f"{ball.name}{suffix}", folder / f"{ball.name}_alpha.png"
    mask = np.rint(coverage(cone, lens) * 255).astype(np.uint8)
    unknown = hidden(ball) | light.unknown
    mask = np.where(unknown, np.minimum(mask, HIDDEN_ALPHA), mask)
    write_png(mask_file, mask, quick=True)
    if light.radiance is not None:
        write_exr_rgb(picture, light.radiance)
    else:
        write_png(picture, ball.shot.codes(), quick=True)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ cone.center
    return Frame(f"train/{ball.name}", lens.pinhole(pose), stem, suffix, mask_file, covariance)
