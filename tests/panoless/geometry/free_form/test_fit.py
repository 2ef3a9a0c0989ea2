"""Free-form surfaces from pictures of bodies that are traced by something else."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from panoless.capture.corrections import NO_CORRECTIONS, with_silhouette_moved
from panoless.capture.lens import with_focal_factor
from panoless.capture.poses import Poses, StatedCameras
from panoless.capture.views import Views, views_of
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Floor, Surroundings
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.geometry.free_form import fit, start, steps
from panoless.geometry.free_form.equations import SILHOUETTE_SCALE_PX, silhouette_rows
from panoless.geometry.free_form.fit import (
    HELD_OUT_RAYS,
    FitStage,
    coarse_stage,
    distrusted_share,
    fit_free_form,
    held_out_error,
    refitted_stages,
    take_round,
)
from panoless.geometry.free_form.kind import FreeFormFamily, FreeFormMirror
from panoless.geometry.free_form.options import FreeFormOptions
from panoless.geometry.free_form.photometric import INNER_PX, LEAST_COSINE, Linearization, ReflectedRays
from panoless.geometry.free_form.schedule import COARSE, DESCENT, DETAILED, Round, Schedule
from panoless.geometry.free_form.start import FirstSurfaces, first_surfaces, started
from panoless.geometry.free_form.steps import Change, gauss_newton_step
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.task import make_task
from panoless.geometry.free_form.trust import full_trust
from panoless.kernels.level_set import seen_with_slopes
from panoless.kernels.reference.cubemap import padded_texels
from panoless.problem.blocks import BLOCKS, Block, Exposures, MaskOffsets, Walls
from panoless.problem.nuisance import NO_NUISANCE, Nuisance, nuisance_of
from panoless.problem.observations import background_rays, silhouette_rays, solid_pixels
from shinypartial.core.camera import Camera, Similarity
from tests.support.mirror_body import (
    Body,
    block,
    body_views,
    camera_rays_world,
    cameras_around,
    ellipsoid,
    in_frame,
    photograph,
    sphere,
    torus,
    true_normals,
    wavy_ball,
)

OPTIONS = FreeFormOptions(concavities=False, starts=False, finest_cells=28)
SCHEDULE = replace(
    Schedule.of(OPTIONS), coarse=tuple(replace(settings, rays=settings.rays // 2) for settings in COARSE)
)
FEW_PIXELS = replace(
    SCHEDULE,
    coarse=tuple(replace(settings, rays=8_000) for settings in SCHEDULE.coarse),
    refit=tuple(replace(settings, rays=8_000) for settings in SCHEDULE.refit),
)
FIRST_ROUND = replace(COARSE[0], rays=5_000)
SECOND = Round(20, 32, 0.20, 1, 20_000, 100.0, 5)
"""A round on the grid of the first, by pixels' centers."""
FIRST = FirstSurfaceOptions(hull_resolution=56)
CONFIG = replace(FitConfig(), free_form=OPTIONS, first_surface=FIRST)
VIEWS, SIZE_PX = 20, 64


def fitted(views: Views, schedule: Schedule = SCHEDULE, hull: FirstSurfaceOptions = CONFIG.first_surface) -> LevelSet:
    first = first_surfaces(views, replace(CONFIG, first_surface=hull))
    return fit_free_form(views, started(views, first, schedule)[0], schedule)[0].surface


def normal_errors_deg(surface: LevelSet, body: Body, views: Views, cameras: list[Camera]) -> np.ndarray:
    """Where the body mirrors the surroundings at once; a miss counts as 90°."""
    errors = []
    for camera in cameras:
        normals, _, clear = true_normals(body, camera)
        origins, directions = camera_rays_world(camera, 1)
        hits = surface.hits(in_frame(views.object_frame, origins[clear]), directions[clear])
        cross = np.linalg.norm(np.cross(hits.normals, normals[clear]), axis=1)
        angle = np.degrees(np.arctan2(cross, (hits.normals * normals[clear]).sum(1)))
        errors.append(np.where(hits.met, angle, 90.0))
    return np.concatenate(errors)


@pytest.fixture(scope="module")
def ring() -> tuple[Views, FreeFormMirror]:
    """A torus, which sees itself, and its fit."""
    views, family = body_views(torus(), 16, 80), FreeFormFamily()
    proposal = family.propose(views, CONFIG, requested=False)
    assert proposal is not None
    geometry, _, _ = family.solve(views, proposal, (), (), CONFIG, lambda _: None)
    assert isinstance(geometry, FreeFormMirror)
    return views, geometry


@pytest.mark.parametrize(
    "body",
    [ellipsoid(), sphere(), wavy_ball()],
    ids=["ellipsoid", "sphere", "wavy"],
)
@pytest.mark.slow
def test_a_body_is_recovered_from_its_visual_hull(body: Body) -> None:
    views = body_views(body, VIEWS, SIZE_PX)
    errors = normal_errors_deg(fitted(views), body, views, cameras_around(7, 60)[1::2])
    assert np.median(errors) < 0.3
    assert np.quantile(errors, 0.9) < 0.6


@pytest.mark.slow
def test_a_ring_is_recovered_though_it_sees_itself(ring: tuple[Views, FreeFormMirror]) -> None:
    views, geometry = ring
    errors = normal_errors_deg(geometry.surface, torus(), views, cameras_around(7, 60)[1::2])
    assert np.median(errors) < 0.3
    assert np.quantile(errors, 0.9) < 1.2


@pytest.mark.slow
def test_the_hole_of_a_ring_stays_open(ring: tuple[Views, FreeFormMirror]) -> None:
    """The mesh of a torus is closed and its Euler characteristic is zero."""
    mesh, normals = ring[1].surface.mesh()
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    assert len(np.unique(mesh.triangles)) - len(unique) + len(mesh.triangles) == 0
    faces = mesh.vertices[mesh.triangles]
    across = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert ((across * normals[mesh.triangles].sum(1)).sum(1) > 0).mean() > 0.999


@pytest.fixture(scope="module")
def dented() -> tuple[Body, Views, FitStage]:
    """An ellipsoid with a dent where cameras face it, and what it trusts after a step under a fine map."""
    body = ellipsoid()
    views = body_views(body, 12, 56)
    right = coarse_stage(views, first_surfaces(views, CONFIG).plain, FEW_PIXELS.coarse).surface
    camera = cameras_around(VIEWS, SIZE_PX)[VIEWS // 2]
    origin, direction = (each.mean(0, keepdims=True) for each in camera_rays_world(camera, 1))
    hit = right.hits(in_frame(views.object_frame, origin), direction / np.linalg.norm(direction))
    away = right.spacing * np.linalg.norm(right.nodes() - hit.places, axis=3)
    dent = replace(right, coefficients=right.coefficients + 1.5 * np.exp(-0.5 * (away / 0.2) ** 2))
    return body, views, take_round(views, FitStage.begun(dent), replace(FEW_PIXELS.coarse[-1], steps=1))


@pytest.mark.slow
def test_parts_that_pixels_distrust_are_refitted(dented: tuple[Body, Views, FitStage]) -> None:
    body, views, stage = dented
    cameras = cameras_around(7, 60)[1::2]
    _, refitted = islice(refitted_stages(views, stage, FEW_PIXELS.refit), 2)
    before, after = (normal_errors_deg(each.surface, body, views, cameras) for each in (stage, refitted))
    assert after.mean() < before.mean() / 3
    assert distrusted_share(views, refitted) < distrusted_share(views, stage) / 3


@pytest.mark.slow
def test_waves_narrower_than_the_first_cells_are_found_under_coarse_maps() -> None:
    """Their normals turn by 15° and more. Measured: 0.3° in the median; 8.3° without the rounds that look for them."""
    body, cameras = wavy_ball(0.03, 9.0), cameras_around(16, 64)
    short = tuple(replace(each, rays=8_000, steps=4) for each in DETAILED[:4])
    schedule = replace(FEW_PIXELS, refit=(), detailed=short)
    views = body_views(body, len(cameras), 64)
    assert np.median(normal_errors_deg(fitted(views, schedule), body, views, cameras[::5])) < 0.6


@pytest.mark.slow
def test_rounds_that_look_for_details_are_refused_where_held_out_views_gain_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a ball that is explained already, and no finer round takes their cells away again."""
    views, details = body_views(sphere(), 10, 40), Round(24, 4, 0.8, 1, 2_000, 30.0, 1)
    coarse = replace(FEW_PIXELS, coarse=(replace(FIRST_ROUND, steps=2),), refit=())
    first = first_surfaces(views, CONFIG).plain
    monkeypatch.setattr(fit, "DETAILED_ERROR", -1.0)
    alone, refused = (
        fit_free_form(views, first, each)[0].surface for each in (coarse, replace(coarse, detailed=(details,)))
    )
    monkeypatch.setattr(fit, "LEAST_GAIN", -99.0)
    finer = replace(coarse, detailed=(details,), finer=(replace(details, cells=22),))
    taken = fit_free_form(views, first, finer)[0].surface
    np.testing.assert_array_equal(refused.coefficients, alone.coefficients)
    assert (alone.cells, taken.cells) == (FIRST_ROUND.cells, details.cells)


@pytest.mark.slow
def test_details_begin_at_the_hull_and_end_at_cells_as_wide_as_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds without steps leave a surface where it begins; held-out views are made to accept any."""
    views, still = body_views(sphere(), 10, 40), Round(24, 4, 0.8, 1, 2_000, 30.0, 0)
    first = first_surfaces(views, CONFIG)
    hull = replace(first.plain, coefficients=first.plain.coefficients + 0.5)
    finest = replace(still, cells=26), replace(still, cells=400)
    schedule = replace(FEW_PIXELS, coarse=(replace(FIRST_ROUND, steps=1),), refit=(), detailed=(still,), finest=finest)
    monkeypatch.setattr(fit, "DETAILED_ERROR", -1.0)
    monkeypatch.setattr(fit, "LEAST_GAIN", -99.0)
    monkeypatch.setattr(fit, "LEAST_FINER_GAIN", -99.0)
    found = fit_free_form(views, first.plain, schedule, hull=hull)[0].surface
    np.testing.assert_allclose(found.coefficients, hull.resampled(24).resampled(26).coefficients, atol=1e-9)


def test_what_pixels_trust_is_not_refitted() -> None:
    """However wrong it is: here the hull."""
    views = body_views(sphere(), 8, 32)
    hull = first_surfaces(views, replace(CONFIG, first_surface=FirstSurfaceOptions(hull_resolution=28))).hull
    trusted = replace(FitStage.begun(hull), trust=full_trust(hull))
    assert list(refitted_stages(views, trusted, FEW_PIXELS.refit)) == [trusted]


@pytest.mark.slow
def test_held_out_pixels_that_miss_the_surface_are_unexplained() -> None:
    """Under one color all around, which any surface explains, the error is the share of the pixels that miss it."""
    views = body_views(sphere(), 10, 48)
    train = [replace(view, radiance=torch.full_like(view.radiance, 0.5)) for view in views.train]
    solved, tested = (replace(views, train=tuple(part)) for part in (train[:8], train[8:]))
    whole = first_surfaces(views, CONFIG).hull
    small = replace(whole, coefficients=whole.coefficients + 0.3 / whole.spacing)
    pixels = solid_pixels(tested, HELD_OUT_RAYS)
    for surface, bare in ((whole, False), (small, True)):
        reflected, inner = ReflectedRays.of(surface, pixels.rays, 1, LEAST_COSINE), pixels.inner_px > INNER_PX
        missed, clear = (inner & ~reflected.hits.met).sum(), (inner & reflected.clear).sum()
        assert (missed > 0.2 * clear) == bare
        error = held_out_error(solved, tested, FitStage.begun(surface))
        assert error == pytest.approx(missed / (missed + clear), abs=1e-3)


@pytest.mark.slow
def test_a_world_that_is_turned_and_scaled_gives_the_same_surface() -> None:
    """Up to the grid, whose axes are those of the world: normals agree far below their errors' scale."""
    body, turn = ellipsoid(), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    cameras = cameras_around(VIEWS, SIZE_PX)
    views = body_views(body, VIEWS, SIZE_PX)
    photographs = []
    for camera in cameras:
        pose = camera.camera_to_world.copy()
        pose[:3] = np.concatenate([turn @ pose[:3, :3], 7 * turn @ pose[:3, 3:] + [[1], [2], [3]]], 1)
        photographs.append(replace(photograph(body, camera), camera=replace(camera, camera_to_world=pose)))
    turned = views_of(photographs)
    assert turned.object_frame.radius == pytest.approx(7 * views.object_frame.radius, rel=1e-4)
    before, after = fitted(views), fitted(turned)
    origins, directions = camera_rays_world(cameras[3], 1)
    origins = in_frame(views.object_frame, origins)
    hits, moved = before.hits(origins, directions), after.hits(origins @ turn.T, directions @ turn.T)
    both = hits.met & moved.met
    angle = np.degrees(np.linalg.norm(hits.normals[both] @ turn.T - moved.normals[both], axis=1))
    assert np.median(angle) < 0.05


@pytest.fixture(scope="module")
def linearization() -> Linearization:
    """A wavy ball between two rounds."""
    views = body_views(wavy_ball(), 12, 60)
    surface = fitted(views, replace(SCHEDULE, coarse=SCHEDULE.coarse[:1]))
    return Linearization.at(make_task(views, SECOND), surface, full_trust(surface, 20), None, 2)


@pytest.mark.slow
def test_a_step_with_the_map_solved_again_gains_what_its_equations_promise(linearization: Linearization) -> None:
    step = gauss_newton_step(linearization, 1e-3).coefficients
    promised = (
        -float((step * linearization.gradient()[0]).sum()) - float((step * linearization.product(step)[0]).sum()) / 2
    )
    surface = replace(linearization.surface, coefficients=linearization.surface.coefficients + step)
    moved = Linearization.at(linearization.task, surface, linearization.trust, linearization.environment, 3)
    gained = linearization.cost(linearization) - moved.cost(linearization)
    assert promised > 0
    assert 0.4 < gained / promised < 1.6


def test_the_gradient_is_that_of_finite_differences(linearization: Linearization) -> None:
    """Of silhouettes and gauge; silhouettes near to zero hardly feel the slope that their distances are divided by."""
    parts = linearization.silhouettes, linearization.gauge
    gradient = sum(rows.backward(rows.residual, linearization.surface.shape) for rows in parts) * linearization.active
    change, costs = 1e-3 * gradient / np.abs(gradient).max(), []
    for sign in (-1, 1):
        surface = replace(linearization.surface, coefficients=linearization.surface.coefficients + sign * change)
        moved = replace(linearization, surface=surface)
        costs.append(moved.silhouettes.cost + moved.gauge.cost)
    assert (costs[1] - costs[0]) / 2 == pytest.approx(float((gradient * change).sum()), rel=0.02)


def test_a_prior_on_the_increment_smooths_the_change_alone(linearization: Linearization) -> None:
    coefficients = linearization.surface.coefficients
    same = replace(linearization, task=replace(linearization.task, reference=coefficients))
    assert np.abs(same.bent).max() == 0
    np.testing.assert_allclose(
        linearization.gradient()[0] - same.gradient()[0], linearization.bent * linearization.active, atol=1e-9
    )
    free = replace(linearization, task=replace(linearization.task, reference=np.zeros_like(coefficients)))
    np.testing.assert_array_equal(free.bent, linearization.bent)
    assert same.cost(same) < linearization.cost(linearization) == free.cost(free)


@pytest.mark.parametrize("cells", [-1.0, 1.0])
def test_a_step_that_moves_all_of_the_surface_alike_costs_no_smoothness(
    linearization: Linearization, cells: float
) -> None:
    """Third differences of a constant are zero; coefficients that come near the surface have not been smoothed yet."""
    moved = replace(
        linearization, surface=replace(linearization.surface, coefficients=linearization.surface.coefficients + cells)
    )
    assert (moved.active & ~linearization.active).any()
    assert moved.prior(linearization) == pytest.approx(linearization.prior(linearization), rel=1e-9)
    assert moved.prior(moved) != pytest.approx(linearization.prior(linearization), rel=0.1)


def with_waves(surface: LevelSet) -> LevelSet:
    waves = 4 * np.sin(0.5 * np.arange(surface.shape[0]))[:, None, None]
    return replace(surface, coefficients=surface.coefficients + waves)


@pytest.mark.slow
def test_a_start_that_descended_is_taken_where_pixels_agree_better() -> None:
    """Not the plain surface with waves but what a plate or the hull leads to."""
    views = body_views(sphere(), 8, 32)
    right, one = first_surfaces(views, CONFIG).plain, Round(12, 4, 0.5, 1, 500, 100.0, 1, increment_prior=True)
    schedule = replace(SCHEDULE, coarse=(replace(one, increment_prior=False),), descent=(one,))
    wrong = with_waves(right)
    assert started(views, FirstSurfaces(wrong, wrong, (right,)), schedule)[0].cells == one.cells
    assert started(views, FirstSurfaces(wrong, right, (wrong,)), schedule)[0].cells == one.cells


@pytest.mark.slow
def test_the_plain_surface_descends_alone_where_pixels_agree_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dominated by silhouettes; where any disagreement is little enough, a ball that is at hand is not tried."""
    views = body_views(sphere(), 8, 32)
    right = first_surfaces(views, CONFIG).plain
    wrong = with_waves(right)
    one = Round(12, 4, 0.5, 1, 500, 100.0, 1, increment_prior=True)
    monkeypatch.setattr(start, "LEAST_DISAGREEMENT", np.inf)
    schedule = replace(SCHEDULE, coarse=(replace(one, increment_prior=False),), descent=(one,))
    dominated = coarse_stage(views, wrong, [replace(one, silhouette_dominated=True)]).surface
    found, _ = started(views, FirstSurfaces(wrong, right, (right,)), schedule)
    np.testing.assert_array_equal(found.coefficients, dominated.coefficients)


def test_the_matrix_is_symmetric_and_positive(linearization: Linearization) -> None:
    rng = np.random.default_rng(1)
    one, other = (rng.normal(size=linearization.surface.shape) * linearization.active for _ in range(2))
    assert (one * linearization.product(other)[0]).sum() == pytest.approx(
        (other * linearization.product(one)[0]).sum(), rel=1e-6
    )
    assert (one * linearization.product(one)[0]).sum() > 0


@pytest.mark.slow
def test_held_out_views_refuse_cells_that_a_ball_does_not_need() -> None:
    """Two more rounds are offered, and the one with a rough surface is not taken."""
    rough = Round(34, 32, 0.15, 1, 10_000, 1e-6, 2)
    views = body_views(sphere(), 10, 40)
    surface = fitted(views, replace(SCHEDULE, coarse=(FIRST_ROUND, replace(SECOND, rays=5_000)), finer=(rough,)))
    assert max(surface.shape) < 34


@pytest.mark.slow
def test_the_same_views_give_the_same_surface() -> None:
    """A killed fit in closed form starts again, so it ends where the other would have."""
    views = body_views(sphere(), 8, 32)
    schedule = replace(SCHEDULE, coarse=(replace(FIRST_ROUND, cells=14, steps=2),))
    one, other = (fitted(views, schedule, FirstSurfaceOptions(hull_resolution=28)) for _ in range(2))
    np.testing.assert_array_equal(one.coefficients, other.coefficients)


def test_the_kind_keeps_the_protocol(ring: tuple[Views, FreeFormMirror]) -> None:
    """State, rays, buffers, light, mesh and surfels of one fit."""
    views, geometry = ring
    again = FreeFormMirror.from_state_dict(geometry.state_dict())
    np.testing.assert_array_equal(again.surface.coefficients, geometry.surface.coefficients)
    np.testing.assert_array_equal(again.trust.values, geometry.trust.values)
    assert again.occlusion_test == geometry.occlusion_test
    assert 500 < geometry.num_parameters < geometry.surface.coefficients.size

    view = views.train[5]
    usable = geometry.usable_pixels(view)
    assert 0.5 < len(usable) / len(view.solid) < 1
    rays = geometry.observe(view, usable)
    assert len(rays.directions) == len(usable)
    assert rays.trust is not None
    buffers = geometry.buffers(view.camera)
    assert float((buffers.alpha - view.mask).abs().mean()) < 0.01
    solid = buffers.alpha > 0.99
    assert float((buffers.normals_camera.norm(dim=0)[solid] - 1).abs().max()) < 1e-5
    environment, _ = geometry.solve_map(views, CONFIG)
    light = geometry.shade(environment, view.camera, view.solid, buffers.normals_camera.flatten(1)[:, view.solid])
    error = (light - view.radiance.flatten(1)[:, view.solid].T).abs()
    assert float(error.median()) < 0.02
    mesh = geometry.mesh(views.object_frame)
    assert np.abs(torus().value(mesh.vertices)).max() < 0.15
    assert set(mesh.columns) == {"nx", "ny", "nz", "confidence"}
    confidence = mesh.columns["confidence"]
    assert 0 <= confidence.min() < 0.1, "Nobody saw the back."
    assert np.median(confidence[mesh.columns["nx"] > 0.8]) > 0.8


@pytest.mark.parametrize("kind", BLOCKS, ids=[kind.name for kind in BLOCKS])
def test_rows_of_a_block_are_those_of_finite_differences(linearization: Linearization, kind: type[Block]) -> None:
    """Of photographs under a map and on a surface that stay, and of silhouettes."""
    near = Surroundings(np.array([0.1]), Floor(np.array([0.0, 0.0, 1.0]), 1.2, 4.0))
    block = kind.of(body_views(wavy_ball(), 12, 20), near)
    assert block is not None
    known, nuisance = linearization.environment, Nuisance((block,), (block.name,))
    moved = Linearization.at(linearization.task, linearization.surface, linearization.trust, known, 0, nuisance)
    change = 1e-5 * np.random.default_rng(0).normal(size=block.values.shape)
    change -= change.mean(0) if kind.by_view and kind.count < 6 else 0
    sides = [replace(moved, nuisance=Nuisance((block.stepped(sign * change),))) for sign in (1, -1)]
    photographs, silhouettes = moved.beside[0].photographs, moved.beside[0].silhouettes
    clear, left = moved.reflected.clear, []
    length = linearization.environment.shape[-1] + 2
    padded = padded_texels(linearization.environment).reshape(6, length, length, 3).double().numpy()
    for side in sides:
        surface = replace(linearization.surface, surroundings=side.nuisance.around(FAR))
        reflected = ReflectedRays.of(surface, side.rays, linearization.task.settings.samples, LEAST_COSINE)
        clear = clear & reflected.clear
        radiance = linearization.task.pixels.radiance * np.exp(-side.nuisance.log_gains(side.rays.view))
        left.append(seen_with_slopes(padded, reflected.outgoing)[0] - radiance)
    clear &= photographs.weights > 0
    expected = ((left[0] - left[1]) / 2 * moved.gain)[clear]
    found = photographs.forward(change)[clear]
    if block.gain_rows() is not None:
        # By the light of the map, in place of the pixel's.
        bright = np.abs(moved.residual[clear]) < 0.05 * np.abs(expected / np.abs(change).max())
        expected, found = expected[bright], found[bright]
    assert len(expected) > 100
    assert np.median(np.abs(found - expected)) <= 0.02 * np.median(np.abs(expected))
    count = len(linearization.task.silhouettes.size)
    expected = ((sides[0].silhouettes.residual - sides[1].silhouettes.residual) / 2)[:count]
    found = silhouettes.forward(change)[:count]
    assert np.median(np.abs(found - expected)) <= 0.01 * np.median(np.abs(expected))


def all_free(views: Views) -> Nuisance:
    """Every block, none of them at zero."""
    rng, nuisance = np.random.default_rng(3), nuisance_of(views)
    return nuisance.replaced([each.stepped(1e-3 * rng.normal(size=each.values.shape)) for each in nuisance.blocks])


def test_the_matrix_with_all_unknowns_is_symmetric(linearization: Linearization) -> None:
    near = Surroundings(np.array([0.1, 0.02, 0.0, 0.01]))
    nuisance = all_free(body_views(wavy_ball(), 12, 20)).replaced([Walls.about(near)])
    moved = replace(linearization, surface=replace(linearization.surface, surroundings=near), nuisance=nuisance)
    sizes = moved.surface.shape, *(each.value.shape for each in moved.beside)
    rng = np.random.default_rng(1)
    one, other = (([rng.normal(size=size) for size in sizes]) for _ in range(2))

    def dot(first: list[np.ndarray], second: list[np.ndarray]) -> float:
        change, beside = moved.product(second[0] * moved.active, second[1:])
        ahead = [change, *beside]
        return float(sum((a * b).sum() for a, b in zip([first[0] * moved.active, *first[1:]], ahead, strict=True)))

    assert dot(one, other) == pytest.approx(dot(other, one), rel=1e-6)
    assert dot(one, one) > 0


@pytest.mark.slow
def test_blocks_of_views_end_where_scipy_ends(linearization: Linearization) -> None:
    """Under a surface and a map that stay: the cost of exposures and masks is no higher than that of its minimum."""
    nuisance = nuisance_of(body_views(wavy_ball(), 12, 20), [Exposures, MaskOffsets])
    settings = replace(linearization.task.settings, steps=12, under_known_map=True, least_gain=0.0)
    task = replace(linearization.task, settings=settings)
    gains = np.linspace(-0.2, 0.2, 12)
    darker = replace(task.pixels, radiance=task.pixels.radiance * np.exp(gains)[task.pixels.rays.view, None])
    begun = Linearization.at(
        replace(task, pixels=darker), linearization.surface, linearization.trust, linearization.environment, 0, nuisance
    )
    found, _ = steps.take_steps(begun, 1e-3, still=True)

    def cost(values: np.ndarray) -> float:
        changed = begun.nuisance.stepped(values.reshape(12, 2), None)
        return begun.after(np.zeros(begun.surface.shape), [changed_values(begun.nuisance, changed)]).cost(begun)

    least = minimize(cost, np.zeros(24), method="L-BFGS-B", options={"maxiter": 8})
    assert found.cost(begun) <= least.fun * 1.001
    np.testing.assert_allclose(found.nuisance.get(Exposures).values[:, 0], gains, atol=0.02)


def changed_values(before: Nuisance, after: Nuisance) -> np.ndarray:
    """The step from one to the other, a view a row."""
    pairs = zip(before.blocks, after.blocks, strict=True)
    return np.concatenate([new.values - old.values for old, new in pairs], 1)


def test_a_refused_step_is_tried_again_with_more_damping(
    linearization: Linearization, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is refused below a damping of 0.06, a round goes on until that is reached, and then moves."""
    tried: list[float] = []

    def step(linearization: Linearization, damping: float, **_: bool) -> Change:
        tried.append(damping)
        found = gauss_newton_step(linearization, damping)
        return found if damping > 0.06 else replace(found, coefficients=-100 * found.coefficients)

    monkeypatch.setattr(steps, "gauss_newton_step", step)
    settings = replace(linearization.task.settings, steps=3)
    moved, _ = steps.take_steps(replace(linearization, task=replace(linearization.task, settings=settings)), 1e-3)
    assert tried[0] == 1e-3
    assert tried[1] > 0.06
    assert moved.cost(linearization) < linearization.cost(linearization)


@pytest.mark.slow
def test_flat_faces_that_no_silhouette_shows_are_found_by_a_descent() -> None:
    """The corner of a block faces the cameras. By the median of normals a start that descended is wrong by 1.6°, the
    plain one by 22°.
    """
    views = body_views(block(), VIEWS, SIZE_PX)
    first = first_surfaces(views, CONFIG)

    def error_deg(schedule: Schedule) -> float:
        surface, _ = started(views, first, schedule)
        return float(np.median(normal_errors_deg(surface, block(), views, cameras_around(7, 60)[1::2])))

    assert error_deg(replace(SCHEDULE, descent=DESCENT)) < 3.0 < 12.0 < error_deg(SCHEDULE)


@pytest.mark.slow
def test_dominant_silhouettes_keep_faces_that_maps_of_few_texels_would_turn() -> None:
    """After two rounds of the descent from a rounded plate, by the mean of normals: 3.3° so, 17° by pixels alone."""
    body = block(exponent=10.0)
    views = body_views(body, 16, 56)
    first = first_surfaces(views, CONFIG).plates[1]

    def error_deg(*, dominated: bool) -> float:
        rounds = [replace(each, silhouette_dominated=dominated) for each in DESCENT[:2]]
        with torch.no_grad():
            surface = coarse_stage(views, first, rounds).surface
        return float(np.mean(normal_errors_deg(surface, body, views, cameras_around(7, 60)[1::2])))

    assert error_deg(dominated=True) < 4.0 < 12.0 < error_deg(dominated=False)


def test_what_all_cameras_share_is_taken_back() -> None:
    """A turn of 0.6°, a shift and a scale of cameras leave the poses that they had apart from it."""
    cameras = body_views(ellipsoid(), 8, 24)
    stated = StatedCameras.of(cameras)
    rng, prior = np.random.default_rng(2), np.tile(1e4 * np.eye(6), (8, 1, 1))
    own = Poses(1e-3 * rng.normal(size=(8, 3)), 1e-3 * rng.normal(size=(8, 3)))
    own = own.without_common(stated, prior)[1]
    turn = Rotation.from_rotvec([0.004, -0.008, 0.005])
    common = Similarity(1.003, turn.as_matrix(), np.array([0.01, 0.0, -0.02]))
    shifted = common(stated.centers + own.shifts) - stated.centers
    both = Poses((turn * Rotation.from_rotvec(own.turns)).as_rotvec(), shifted)
    found = both.without_common(stated, prior)[1]
    # The least squares are those of small changes, so squares of these are left.
    np.testing.assert_allclose(found.stacked, own.stacked, atol=5e-4)
    assert found.lens_turn(stated, prior) is None


def turned_by(views: Views, degrees: float, seed: int) -> Poses:
    """Turns by that much, each about an axis of its own."""
    axes = np.random.default_rng(seed).normal(size=(len(views.train), 3))
    turns = np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Poses(turns, np.zeros_like(turns))


def left_deg(found: Poses, wrong: Poses) -> float:
    """The median of what is left of turns, but for what all cameras share."""
    left = Rotation.from_rotvec(found.turns) * Rotation.from_rotvec(wrong.turns)
    return float(np.degrees(np.median((left.mean().inv() * left).magnitude())))


def test_photographs_agree_with_masks_unless_silhouettes_lie_to_one_side_of_them(linearization: Linearization) -> None:
    """A surface that is larger by 0.05 px is as near to the masks as others may be, but lies to one side of
    them."""

    def apart_px(moved: Linearization) -> float:
        return float(np.median(moved.silhouettes.residual[: len(moved.task.silhouettes.view)]))

    def larger(cells: float) -> Linearization:
        surface = replace(linearization.surface, coefficients=linearization.surface.coefficients - cells)
        return replace(linearization, surface=surface)

    cells_a_pixel = 0.01 / (apart_px(larger(0.0)) - apart_px(larger(0.01)))
    level = apart_px(linearization) * cells_a_pixel
    assert larger(level).silhouettes_agree
    for off_px in (-0.2, -0.05, 0.05, 0.2):
        assert not larger(level + off_px * cells_a_pixel).silhouettes_agree


def test_rays_that_pass_the_box_of_a_surface_cost_as_outliers(ring: tuple[Views, FreeFormMirror]) -> None:
    """So a camera that turns away from the object gains nothing."""
    views, geometry = ring
    away = turned_by(views, 60.0, 0)
    silhouettes = silhouette_rays(views)
    none = silhouettes.chosen(slice(0))
    costs = [
        silhouette_rows(geometry.surface, rays, none, none, 1.0, 1.0, NO_NUISANCE)[0].cost
        for rays in (silhouettes, silhouettes.moved(away))
    ]
    assert costs[1] > 10 * costs[0]
    assert costs[1] > 0.49 * len(silhouettes.size) * SILHOUETTE_SCALE_PX**2


def test_what_shows_beside_its_mask_is_pulled_back(ring: tuple[Views, FreeFormMirror]) -> None:
    """A ring that is 6 px too thick, by the pixels that should not see it; the right one costs nothing."""
    views, geometry = ring
    surface, beside = geometry.surface, background_rays(views, 4_000)
    none, pixel = beside.chosen(slice(0)), np.median(beside.size) * np.linalg.norm(beside.origins[0]) / surface.spacing
    for thicker_px, least, most in ((0.0, 0, 0), (6.0, 50, len(beside.size))):
        thicker = replace(surface, coefficients=surface.coefficients - thicker_px * pixel)
        met = beside.chosen(thicker.meets(beside.origins, beside.directions))
        rows, _ = silhouette_rows(thicker, none, none, met, 1.0, 1.0, NO_NUISANCE)
        assert least <= np.count_nonzero(rows.weights) <= most
        change = np.ones(surface.shape)
        assert ((rows.forward(change) * rows.residual).sum() < 0) == (thicker_px > 0)


def wronged(views: Views) -> tuple[Views, dict[str, np.ndarray]]:
    """Four errors at once: cameras turned by 0.3°, exposures, masks of each view and the focal length."""
    rng, count = np.random.default_rng(5), len(views.train)
    truth = {
        "gains": rng.normal(scale=0.1, size=count),
        "masks": rng.uniform(-1, 1, count),
        "focal": np.array([np.log(1.01)]),
    }
    seen = turned_by(views, 0.3, 1).moved(views)
    train = [
        with_silhouette_moved(
            replace(with_focal_factor(view, 1.01), radiance=(view.radiance * float(np.exp(gain))).clamp(max=1)), offset
        )
        for view, gain, offset in zip(seen.train, truth["gains"], truth["masks"], strict=True)
    ]
    return replace(seen, train=tuple(train)), truth


@pytest.mark.slow
@pytest.mark.parametrize("body", [wavy_ball(), torus()], ids=["ball", "ring"])
def test_four_errors_at_once_are_found_together(body: Body) -> None:
    """Their own blocks are kept, with their values, and no others but what a small picture hides."""
    views, family = body_views(body, 25, 80), FreeFormFamily()
    wrong, truth = wronged(views)
    geometry, corrections, decisions = family.solve(
        wrong, family.propose(wrong, CONFIG, requested=True), BLOCKS, (), CONFIG, lambda _: None
    )
    kept = {each.name for each in decisions if each.kept}
    assert kept >= {"poses", "exposures", "mask offsets", "focal length"}
    assert not kept & {"white balances", "distortion"}
    assert left_deg(geometry.poses, turned_by(views, 0.3, 1)) < 0.08
    gains = np.log(corrections.gains) - truth["gains"]
    assert gains.std() < 0.01
    assert (corrections.mask_offsets_px + truth["masks"]).std() < 0.2
    assert corrections.focal_factor == pytest.approx(1 / 1.01, abs=0.004)


@pytest.mark.slow
def test_right_photographs_free_no_block() -> None:
    views, family = body_views(wavy_ball(), 25, 80), FreeFormFamily()
    geometry, corrections, decisions = family.solve(
        views, family.propose(views, CONFIG, requested=True), BLOCKS, (), CONFIG, lambda _: None
    )
    assert not any(each.kept for each in decisions)
    assert len(decisions) == len(BLOCKS) - 1, "all but the walls"
    assert geometry.poses is None
    assert corrections == NO_CORRECTIONS
