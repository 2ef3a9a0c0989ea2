"""Balls in traced photographs: the rim to part of a pixel, what hides it, and pictures without a ball."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float, UInt8

from panoless.photographs.ball.adjust import cone_of
from panoless.photographs.ball.cone import BallCone
from panoless.photographs.ball.find import find_ball, find_balls, hidden
from panoless.photographs.masks import Hint
from panoless.photographs.shot import Shot
from shinypartial.core.errors import InputError
from shinypartial.io.images import write_jpeg
from tests.panoless.photographs.ball.conftest import FAR, Taken, shot_of
from tests.support.traced_ball import HEIGHT, WIDTH, Room, Scene, camera_at, developed, exif, lens_of

LENS = lens_of()
RIM_PX = 1.25
"""Of a ball of 77 px: what it mirrors meets what lies beside it without a step, so that parts of the rim are weak and
others are taken from edges inside. Measured in the median: middles to 0.5 and 1.1 px, radii to 0.4 px.
"""
RADIUS_PX = 0.5


def cone_errors(cone: BallCone, pose: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """How far a cone is off, in pixels: its axis, and its radius (positive: too large)."""
    center = -pose[:3, :3].T @ pose[:3, 3]
    distance = np.linalg.norm(center)
    aside = np.linalg.norm(LENS.project(cone.axis) - LENS.project(center / distance))
    return float(aside), float(LENS.fx * (np.tan(cone.half_angle) - np.tan(np.arcsin(1 / distance))))


@pytest.mark.parametrize("room", ["far", "near"])
def test_the_rim_of_a_ball_is_found(room: str, request: pytest.FixtureRequest) -> None:
    taken: Taken = request.getfixturevalue(room)
    cones = [cone_of(ball.rim.points, LENS)[0] for ball in taken.balls]
    errors = np.array([cone_errors(cone, pose) for cone, pose in zip(cones, taken.poses, strict=True)])
    assert np.median(errors[:, 0]) < RIM_PX
    assert np.median(np.abs(errors[:, 1])) < RADIUS_PX
    assert all(ball.side == 1 and ball.rim.seen.mean() > 0.6 for ball in taken.balls)


@pytest.mark.parametrize("room", ["far", "near"])
def test_what_several_balls_mirror_sets_their_rims_right(room: str, request: pytest.FixtureRequest) -> None:
    """To a third of a pixel."""
    taken: Taken = request.getfixturevalue(room)
    cones = taken.posed.adjusted.cones
    errors = np.array([cone_errors(cones[i], taken.poses[i]) for i in taken.posed.members])
    assert (np.median(np.abs(errors), 0) < 0.3).all()


def test_what_a_support_hides_is_a_gap() -> None:
    """A post hides 97° of the rim about its lowest point (azimuth 90°), and the part of the ball beyond its chord."""
    scene, pose = replace(FAR, post=True), camera_at(30, 8)
    ball = find_ball(shot_of(scene.radiance(pose, LENS)))
    aside, wider = cone_errors(cone_of(ball.rim.points, LENS)[0], pose)
    assert aside < 2 * RIM_PX
    assert abs(wider) < 2 * RADIUS_PX
    lowest = [gap for gap in np.degrees(ball.rim.gaps) if gap[0] < 90 < gap[1]]
    assert len(lowest) == 1
    assert 50 < lowest[0][1] - lowest[0][0] < 110
    circle = ball.rim.circle
    cover = hidden(ball)
    assert cover[int(circle.y + 0.95 * circle.radius), int(circle.x)]
    assert not cover[int(circle.y), int(circle.x)]
    assert cover.sum() < 0.2 * np.pi * circle.radius**2


def without_ball(kind: str) -> UInt8[np.ndarray, "H W 3"]:
    """Noise, a checkerboard, and a room with nothing round."""
    if kind == "noise":
        gray = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH)), (0, 0), 2.0)
        return np.repeat(np.rint(np.clip(gray / gray.std() * 50 + 128, 0, 255)).astype(np.uint8)[..., None], 3, 2)
    if kind == "checkerboard":
        down, right = np.indices((HEIGHT, WIDTH)) // 40
        return np.repeat(((down + right) % 2 * 200 + 20).astype(np.uint8)[..., None], 3, 2)
    away = Scene(Room(seed=5, lamps=0), balls=((0.0, 100.0, 0.0, 1.0),))
    return developed(away.radiance(camera_at(180, 0), LENS), noise=0.01)


@pytest.mark.parametrize("kind", ["noise", "checkerboard", "room"])
def test_a_picture_without_a_ball_is_refused(kind: str) -> None:
    with pytest.raises(InputError, match="expected a mirror ball in ball"):
        find_ball(replace(shot_of(np.zeros((HEIGHT, WIDTH, 3))), pixels=without_ball(kind)))


@pytest.fixture(scope="module")
def two_balls() -> Shot:
    """A large ball left of the middle and a smaller one right of it."""
    scene = replace(FAR, balls=((-1.0, 0.0, 0.0, 1.0), (1.3, 0.0, 0.0, 0.7)))
    return shot_of(scene.radiance(camera_at(0, 0, 7.0, (0.0, 0.0, 0.0)), LENS))


def test_of_two_balls_the_larger_one_is_taken(two_balls: Shot) -> None:
    ball = find_ball(two_balls)
    assert ball.has_rival
    circle = ball.rim.circle
    assert circle.x < WIDTH / 2
    assert circle.radius == pytest.approx(LENS.fx / 7, rel=0.05)


@pytest.mark.parametrize("hint", ["click", "rectangle"])
def test_or_the_one_that_a_person_points_at(two_balls: Shot, hint: str) -> None:
    x, y, radius = WIDTH / 2 + LENS.fx * 1.3 / 7, HEIGHT / 2, LENS.fx * 0.7 / 7
    given = Hint(on=((x, y),)) if hint == "click" else Hint((x - radius, y - radius, x + radius, y + radius))
    circle = find_ball(two_balls, given).rim.circle
    assert abs(circle.x - x) < 3
    assert circle.radius == pytest.approx(radius, rel=0.06)


def test_a_click_beside_every_ball_is_refused(two_balls: Shot) -> None:
    with pytest.raises(InputError, match="no circle that edges run along"):
        find_ball(two_balls, Hint(on=((WIDTH / 2, 5.0),)))


def test_a_ball_that_the_border_cuts_is_refused(far: Taken) -> None:
    """The picture ends a third of the radius to the right of its middle."""
    shot, circle = far.shots[0], far.balls[0].rim.circle
    cut = replace(shot, pixels=np.ascontiguousarray(shot.pixels[:, : int(circle.x + 0.6 * circle.radius)]))
    with pytest.raises(InputError, match="the whole ball in p0; found one that the picture's border cuts"):
        find_ball(cut)


def test_a_blurred_ball_is_refused(far: Taken) -> None:
    blurred = cv2.GaussianBlur(far.shots[0].pixels, (0, 0), 5.0)
    with pytest.raises(InputError, match=r"a sharp ball in p0|a mirror ball in p0"):
        find_ball(replace(far.shots[0], pixels=blurred))


def test_large_pictures_are_averaged(far: Taken) -> None:
    """Six times as large: the ball has 460 px of radius, so pixels are averaged over 2 × 2."""
    large = cv2.resize(far.shots[0].pixels, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    found = find_ball(replace(far.shots[0], pixels=large))
    assert found.side == 2
    assert found.gray.shape == (3 * HEIGHT, 3 * WIDTH)
    assert found.rim.circle.radius == pytest.approx(3 * far.balls[0].rim.circle.radius, rel=0.02)


def test_a_sheet_shows_what_was_found(far: Taken, tmp_path: Path) -> None:
    """Also where another photograph shows no ball, of which the error speaks."""
    files = [tmp_path / "one.jpg", tmp_path / "two.jpg"]
    write_jpeg(files[0], far.shots[0].pixels, 95, exif())
    write_jpeg(files[1], without_ball("checkerboard"), 95)
    sheet = tmp_path / "sheet.jpg"
    with pytest.raises(InputError, match="a mirror ball in two"):
        find_balls(files, {}, None, sheet)
    assert sheet.exists()


def test_two_photographs_of_one_name_are_refused(tmp_path: Path) -> None:
    files = [tmp_path / "a" / "one.jpg", tmp_path / "b" / "one.jpg"]
    with pytest.raises(InputError, match="two named one"):
        find_balls(files, {}, None, tmp_path / "sheet.jpg")
