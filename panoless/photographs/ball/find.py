"""Balls in photographs: the circle of most support, its rim, and what a person says of where it is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, UInt8

from panoless.photographs.ball.brackets import is_bracket
from panoless.photographs.ball.rim import Circle, Rim, circle_near, circles, find_rim
from panoless.photographs.lens import Lens, opencv
from panoless.photographs.masks import Hint
from panoless.photographs.shot import Focal, Shot, given_focal, read_shot
from shinypartial.core.errors import InputError
from shinypartial.io.picture_sheet import write_picture_sheet
from shinypartial.io.progress import Progress
from shinypartial.io.threads import in_threads

LARGEST_RADIUS_PX = 400.0
"""Photographs are averaged over blocks of pixels until the ball is no larger: a pixel in its middle then spans 0.3°."""
LEAST_RADIUS_PX = 20.0
LEAST_SCORE = 1.5
"""Of a circle, from which it is a ball: by chance 1.4 at most in 60 photographs, some of patterns of disks."""
RIVAL = 0.75
"""Share of the best score from which a larger circle is taken in its place."""
TRIED = 3
"""Circles of a photograph whose reflections are compared with those of the others."""
OVER_BORDER = 0.02
"""Share of the radius by which a rim may lie beyond the picture."""
BLUR_SIDE_PX, MOST_BLUR = 200, 0.75
"""Blur (Crete et al. 2007, 0 to 1) above which a ball is refused, judged where it is so wide."""
SHEET_PICTURES = 12
HELP_FIND = 'Name a point on it, --clicks FILE with {"NAME": {"on": [[x, y]]}}, or a rectangle, --box and --box-in.'


@dataclass(frozen=True)
class FoundBall:
    """A photograph with its ball, in pixels of the reduced picture."""

    shot: Shot
    side: int
    """It was averaged over blocks of so many pixels a side."""
    candidates: tuple[Circle, ...]
    rim: Rim
    focal: Focal
    gray: UInt8[np.ndarray, "H W"]

    @property
    def name(self) -> str:
        """Of the photograph."""
        return self.shot.name

    @property
    def has_rival(self) -> bool:
        """Whether another circle, apart from it, has as much support, nearly."""
        best = self.candidates[0]
        apart = (each for each in self.candidates[1:] if np.hypot(each.x - best.x, each.y - best.y) > best.radius)
        return any(each.score >= RIVAL * best.score for each in apart)

    def lens(self, focal: Focal) -> Lens:
        """A pinhole of that focal length, centered."""
        width, height = self.shot.size
        pixels = focal.pixels(width, height)
        return Lens(pixels, pixels, width / 2, height / 2, width, height)

    def with_circle(self, circle: Circle) -> "FoundBall":
        """The same photograph with another circle of it as its ball."""
        return replace(self, rim=find_rim(self.gray, circle))


def find_balls(
    files: Sequence[Path],
    hints: Mapping[str, Hint],
    focal_film_mm: float | None,
    sheet: Path,
    found_before: Mapping[Path, FoundBall] = MappingProxyType({}),
) -> list[FoundBall]:
    """Every photograph with its ball. Writes a `sheet` of what was found; InputError where there is none."""
    names = [path.stem for path in files]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(
            expected="photographs with names of their own", found=f"two named {twice[0]}", remedy="Rename one of them."
        )
    progress = Progress("looking for the ball", len(files))

    def work(path: Path) -> FoundBall | tuple[Shot, InputError]:
        if path in found_before:
            progress.advance()
            return found_before[path]
        shot = read_shot(path)
        try:
            return find_ball(shot, hints.get(path.stem), focal_film_mm)
        except InputError as error:
            return shot, error
        finally:
            progress.advance()

    found = list(in_threads(work, files))
    balls = [each for each in found if isinstance(each, FoundBall)]
    if balls:
        write_ball_sheet(sheet, balls)
    return [each if isinstance(each, FoundBall) else _as_beside(*each, balls) for each in found]


def _as_beside(shot: Shot, error: InputError, balls: Sequence[FoundBall]) -> FoundBall:
    """A photograph without a ball that shows, with that of another exposure from the same place; raises the error."""
    for ball in balls:
        reduced = shot.reduced(ball.side)
        if is_bracket(reduced, ball.shot):
            gray = opencv().cvtColor(reduced.codes(), opencv().COLOR_RGB2GRAY)
            return replace(ball, shot=reduced, gray=gray, rim=replace(ball.rim, seen=ball.rim.seen & False))
    raise error


def find_ball(shot: Shot, hint: Hint | None = None, focal_film_mm: float | None = None) -> FoundBall:
    """The ball of a photograph: the circle with most support at its rim, of about equal ones the largest.

    Raises InputError where no circle has enough, and where the ball is cut or blurred.
    """
    cv2 = opencv()
    gray = cv2.cvtColor(shot.codes(), cv2.COLOR_RGB2GRAY)
    found = [each for each in circles(gray) if each.radius >= LEAST_RADIUS_PX]
    if hint is not None:
        found = _at_hint(gray, found, hint)
    if not found or (hint is None and found[0].score < LEAST_SCORE):
        raise InputError(
            expected=f"a mirror ball in {shot.name}",
            found="no circle that edges run along" if not found else f"edges along {found[0].support:.0%} of a circle",
            remedy=HELP_FIND,
        )
    rivals = [each for each in found if each.score >= RIVAL * found[0].score]
    best = max(rivals, key=lambda each: each.radius)
    beyond = max(best.radius - each for each in (best.x, best.y, shot.size[0] - best.x, shot.size[1] - best.y))
    if beyond > OVER_BORDER * best.radius:
        raise InputError(
            expected=f"the whole ball in {shot.name}",
            found=f"one that the picture's border cuts, {beyond:.0f} px of {best.radius:.0f}",
            remedy="Photograph it whole, with some room around it.",
        )
    side = int(np.ceil(best.radius / LARGEST_RADIUS_PX))
    rim = find_rim(gray, best)
    blur = _blur(gray, best)
    if blur > MOST_BLUR:
        raise InputError(
            expected=f"a sharp ball in {shot.name}: blur of at most {MOST_BLUR:.2f}",
            found=f"{blur:.2f}",
            remedy="Focus on the ball, hold still, and use more light.",
        )
    focal = shot.focal if focal_film_mm is None else given_focal(focal_film_mm)
    reduced = shot.reduced(side)
    small = cv2.cvtColor(reduced.codes(), cv2.COLOR_RGB2GRAY)
    candidates = (best, *(each for each in found if each is not best))[:TRIED]
    scaled = tuple(each.scaled(1 / side) for each in candidates)
    return FoundBall(reduced, side, scaled, rim.scaled(1 / side), focal, small)


def _blur(gray: UInt8[np.ndarray, "H W"], circle: Circle) -> float:
    from skimage.measure import blur_effect

    left, top = (max(int(value - circle.radius), 0) for value in (circle.x, circle.y))
    part = gray[top : int(circle.y + circle.radius), left : int(circle.x + circle.radius)]
    scale = min(BLUR_SIDE_PX / max(part.shape), 1.0)
    return float(blur_effect(opencv().resize(part, None, fx=scale, fy=scale, interpolation=opencv().INTER_AREA)))


def _at_hint(gray: UInt8[np.ndarray, "H W"], found: Sequence[Circle], hint: Hint) -> list[Circle]:
    """Circles about the points that were clicked, or within the rectangle; that of the rectangle itself, if none is."""
    if hint.box is not None:
        left, top, right, bottom = hint.box
        guess = Circle((left + right) / 2, (top + bottom) / 2, min(right - left, bottom - top) / 2)
        near = [each for each in found if abs(each.x - guess.x) + abs(each.y - guess.y) < 0.3 * guess.radius]
        return [each for each in near if 0.6 < each.radius / guess.radius < 1.2] or [circle_near(gray, guess)]
    inside = [each for each in found if all(each.contains(*point) for point in hint.on)]
    return [each for each in inside if not any(each.contains(*point) for point in hint.off)]


def write_ball_sheet(path: Path, balls: Sequence[FoundBall]) -> None:
    """What was found: the rim green where it was seen, red where something hides it; the least sure first."""
    cv2 = opencv()
    tiles = {}
    for ball in sorted(balls, key=lambda each: float(each.rim.seen.mean()))[:SHEET_PICTURES]:
        circle = ball.rim.circle
        low = np.maximum(np.array([circle.x, circle.y]) - 1.3 * circle.radius, 0).astype(int)
        high = np.array([circle.x, circle.y]) + 1.3 * circle.radius
        part = ball.shot.codes()[low[1] : int(high[1]), low[0] : int(high[0])]
        scale = 330 / max(part.shape[:2])
        tile = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for x, y in ((ball.rim.points - low) * scale).astype(int):
            cv2.circle(tile, (int(x), int(y)), 1, (40, 230, 60), -1)
        for start, stop in ball.rim.gaps:
            gap = circle.points(np.linspace(start, stop, 24))
            cv2.polylines(tile, [((gap - low) * scale).astype(np.int32)], False, (240, 60, 40), 2)
        tiles[f"{ball.name}  {ball.rim.seen.mean():.0%} of the rim"] = tile
    write_picture_sheet(path, tiles)


def hidden(ball: FoundBall) -> Bool[np.ndarray, "H W"]:
    """Pixels of the ball that its support hides: beyond the chords of the gaps in its rim."""
    cover = np.zeros(ball.gray.shape, np.uint8)
    circle = ball.rim.circle
    for start, stop in ball.rim.gaps:
        beyond, ends = circle.points(np.linspace(start, stop, 48), 1.1), circle.points(np.array([stop, start]))
        silhouette = np.concatenate([beyond, ends])
        opencv().fillPoly(cover, [np.rint(silhouette).astype(np.int32)], 1)
    return cover > 0
