"""What every surface of few numbers keeps to: its derivatives are those of finite differences."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panoless.geometry.height_field.model import flat_height_field
from panoless.geometry.height_field.unknowns import HeightFieldUnknowns
from panoless.geometry.panes.model import CutPlane, flat_panes
from panoless.geometry.plane.model import Plane
from panoless.geometry.plane.unknowns import PlaneUnknowns
from panoless.geometry.revolution.model import SurfaceOfRevolution, closed_profile
from panoless.geometry.revolution.unknowns import RevolutionUnknowns
from panoless.geometry.sphere.model import Sphere
from panoless.geometry.sphere.unknowns import SphereUnknowns
from panoless.problem.parametric import ParametricSurface
from panoless.problem.rays import PixelRays
from shinypartial.core.camera import Similarity

PIXEL = 2e-3


def ball() -> ParametricSurface:
    """A sphere beside the origin."""
    return SphereUnknowns(Sphere(np.array([0.1, -0.05, 0.2]), 0.6))


def pane(frame_height: float = 0.0) -> Plane:
    """A pentagon that faces +z, tilted a little."""
    normal = np.array([0.1, -0.05, 1.0])
    normal /= np.linalg.norm(normal)
    tangent = np.cross([0, 1, 0], normal)
    tangent /= np.linalg.norm(tangent)
    boundary = np.array([[-0.6, -0.5], [0.7, -0.4], [0.65, 0.3], [0.0, 0.6], [-0.7, 0.4]])
    return Plane(normal, 0.05, tangent, np.cross(normal, tangent), boundary, frame_height)


def bent(frame_height: float = 0.0) -> ParametricSurface:
    """Waves over that pentagon."""
    flat = flat_height_field(pane(frame_height), 8)
    waves = 0.004 * np.random.default_rng(0).normal(size=flat.coefficients.shape)
    return HeightFieldUnknowns(replace(flat, coefficients=flat.coefficients + waves))


def cut() -> ParametricSurface:
    """That pentagon in 3 × 2 panes, each with slopes and bends."""
    plane = CutPlane(**vars(pane()), cuts_u=np.array([-0.7, -0.2, 0.3, 0.7]), cuts_v=np.array([-0.5, 0.1, 0.6]))
    flat = flat_panes(plane)
    heights = 0.002 * np.random.default_rng(0).normal(size=flat.coefficients.shape)
    return HeightFieldUnknowns(replace(flat, coefficients=heights))


def vase() -> ParametricSurface:
    """A smooth profile around a tilted axis."""
    height = np.linspace(-0.7, 0.7, 300)
    outer = np.stack([0.45 + 0.12 * np.sin(4 * height), height], 1)
    axis = np.array([0.05, 0.1, 1.0])
    axis /= np.linalg.norm(axis)
    origin = np.array([0.02, 0.03, 0.0])
    origin -= (origin @ axis) * axis
    return RevolutionUnknowns(SurfaceOfRevolution(origin, axis, closed_profile(outer), len(outer)), 1.4 / 299)


SURFACES: dict[str, Callable[[], ParametricSurface]] = {
    "sphere": ball,
    "plane": lambda: PlaneUnknowns(pane()),
    "framed plane": lambda: PlaneUnknowns(pane(0.1)),
    "height field": bent,
    "panes": cut,
    "revolution": vase,
}
OPEN = {"plane": slice(3, 4), "height field": slice(4), "panes": slice(4)}
"""Numbers that silhouettes leave open: the height of a frame that there is not, and what coefficients do as well."""
PHOTOGRAPHS_LEAVE = {"plane": None, "framed plane": None, "height field": 4, "panes": 4}
"""So many of the first numbers photographs do not determine, or all."""


def step_of(surface: ParametricSurface, size: float, seed: int) -> np.ndarray:
    """Of random numbers; smooth along a profile, of which a step moves vertices."""
    step = size * np.random.default_rng(seed).normal(size=surface.count)
    if isinstance(surface, RevolutionUnknowns):
        step[4:] = size * np.sin(np.arange(surface.count - 4) / 6)
    return step


EVERY = pytest.mark.parametrize("name", SURFACES)


def rays_at(targets: np.ndarray, origin: tuple[float, float, float] = (0.4, -2.6, 1.9)) -> PixelRays:
    """From one camera toward points."""
    directions = targets - np.array(origin)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.cross(directions, [0.3, 0.2, 1.0])
    across *= PIXEL / np.linalg.norm(across, axis=1, keepdims=True)
    steps = np.stack([across, np.cross(directions, across)], 1)
    count = len(targets)
    return PixelRays(np.tile(origin, (count, 1)), directions, steps, np.full(count, PIXEL), np.zeros(count, int))


def inner() -> PixelRays:
    """Rays onto all of the surfaces."""
    return rays_at(np.random.default_rng(1).uniform(-0.35, 0.35, (300, 3)) * [1, 1, 0.5])


def moved(rays: PixelRays, motion: np.ndarray) -> PixelRays:
    """Turned and shifted."""
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    return replace(
        rays, origins=rays.origins + motion[3:], directions=rays.directions @ turn.T, steps=rays.steps @ turn.T
    )


@EVERY
def test_normals_change_at_fixed_rays_as_rows_state(name: str) -> None:
    surface, rays = SURFACES[name](), inner()
    found = surface.hits(rays)
    assert found.clear.sum() > 100
    step = step_of(surface, 1e-6, 2)
    if name in PHOTOGRAPHS_LEAVE:
        step[: PHOTOGRAPHS_LEAVE[name]] = 0.0
    ahead, behind = (surface.stepped(sign * step).hits(rays) for sign in (1, -1))
    kept = found.clear & ahead.clear & behind.clear
    difference = (ahead.normals - behind.normals)[kept] / 2
    expected = np.einsum("pck,pk->pc", found.rows, step[found.columns])[kept]
    error, size = np.linalg.norm(difference - expected, axis=1), np.linalg.norm(expected, axis=1)
    assert np.median(error) <= 0.01 * np.median(size)


@EVERY
def test_normals_change_along_the_surface_by_the_shape_operator(name: str) -> None:
    surface, rays = SURFACES[name](), inner()
    found, motion = surface.hits(rays), 1e-5 * np.random.default_rng(3).normal(size=6)
    ahead, behind = (surface.hits(moved(rays, sign * motion)) for sign in (1, -1))
    kept = found.clear & ahead.clear & behind.clear
    facing = np.where(kept, (found.normals * rays.directions).sum(1), 1.0)
    way = motion[3:] + found.distance[:, None] * np.cross(motion[:3], rays.directions)
    slide = way - ((way * found.normals).sum(1) / facing)[:, None] * rays.directions
    expected = np.einsum("pij,pj->pi", found.shape, slide)[kept]
    difference = (ahead.normals - behind.normals)[kept] / 2
    along = ((ahead.points - behind.points) / 2)[kept]
    assert np.median(np.abs(along - slide[kept])) < 0.01 * np.median(np.abs(slide[kept]))
    error = np.linalg.norm(difference - expected, axis=1)
    assert np.median(error) <= 0.03 * np.median(np.linalg.norm(expected, axis=1)) + 1e-12


def edge_rays(surface: ParametricSurface) -> PixelRays:
    """Rays that pass within half a pixel of the silhouette."""
    seen = rays_at(np.random.default_rng(4).uniform(-0.9, 0.9, (40_000, 3)))
    return seen.chosen(np.abs(surface.silhouette(seen).pixels) < 0.5)


@EVERY
def test_silhouettes_change_as_their_rows_state(name: str) -> None:
    surface = SURFACES[name]()
    rays = edge_rays(surface)
    found = surface.silhouette(rays)
    step = step_of(surface, 1e-5, 5)
    if name in OPEN:
        step[OPEN[name]] = 0.0
    ahead, behind = (surface.stepped(sign * step).silhouette(rays) for sign in (1, -1))
    kept = (found.weights > 0) & (ahead.weights > 0) & (behind.weights > 0)
    assert kept.sum() > 40
    difference = (ahead.pixels - behind.pixels)[kept] / 2
    expected = (found.jacobian @ step)[kept]
    assert np.median(np.abs(difference - expected)) < 0.02 * np.median(np.abs(expected))


@EVERY
def test_silhouettes_change_with_motions_of_their_rays(name: str) -> None:
    surface = SURFACES[name]()
    rays = edge_rays(surface)
    found = surface.silhouette(rays)
    scale = 1e-5 * np.median(np.abs(found.by_motion[found.weights > 0]))
    for axis in range(6):
        motion = np.zeros(6)
        motion[axis] = 1e-5
        ahead, behind = (surface.silhouette(moved(rays, sign * motion)) for sign in (1, -1))
        kept = (found.weights > 0) & (ahead.weights > 0) & (behind.weights > 0)
        difference = (ahead.pixels - behind.pixels)[kept] / 2
        assert np.median(np.abs(difference - found.by_motion[kept, axis] * 1e-5)) < 0.02 * scale


@EVERY
def test_a_motion_of_all_cameras_is_taken_back(name: str) -> None:
    """Rays from cameras that went back meet a surface that went back where they did."""
    common = Similarity(1.03, Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix(), np.array([0.02, 0.01, -0.03]))
    surface, rays = SURFACES[name](), inner()
    back = replace(
        rays,
        origins=common.undone(rays.origins),
        directions=rays.directions @ common.rotation,
        steps=rays.steps @ common.rotation,
    )
    before, after = surface.hits(rays), surface.taken_back(common).hits(back)
    np.testing.assert_array_equal(after.clear, before.clear)
    np.testing.assert_allclose(common(after.points)[before.clear], before.points[before.clear], atol=1e-9)
    np.testing.assert_allclose(
        (after.normals @ common.rotation.T)[before.clear], before.normals[before.clear], atol=1e-9
    )
