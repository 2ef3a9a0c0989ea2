"""Free-form surfaces from pictures of bodies that are traced by something else."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from panoless.alignment.search import PosedProposal, align_proposal, fit_with_poses
from panoless.capture.contrast import Contrast
from panoless.capture.lens import LensChange, with_focal_factor
from panoless.capture.options import ContrastOptions
from panoless.capture.poses import Poses, StatedCameras, with_pose_covariances
from panoless.capture.views import Views, views_of
from panoless.config import FitConfig
from panoless.environment.surroundings import Surroundings
from panoless.first_surface.options import FirstSurfaceOptions
from panoless.geometry.base import Geometry
from panoless.geometry.free_form import fit
from panoless.geometry.free_form.equations import silhouette_rows
from panoless.geometry.free_form.fit import (
    Change,
    FitStage,
    coarse_stage,
    distrusted_share,
    fit_free_form,
    gauss_newton_step,
    held_out_error,
    make_task,
    mended_stages,
    take_round,
)
from panoless.geometry.free_form.kind import FreeFormFamily, FreeFormMirror
from panoless.geometry.free_form.observations import outline_rays, solid_pixels
from panoless.geometry.free_form.options import DEFAULTS, ConcaveOptions, DescentOptions, FreeFormOptions, FreeFormRound
from panoless.geometry.free_form.photometric import Sights, Solution
from panoless.geometry.free_form.start import FirstSurfaces, first_surfaces, started
from panoless.geometry.free_form.surface import LevelSet
from panoless.geometry.free_form.trust import full_trust
from panoless.kernels.level_set import seen_with_slopes
from panoless.kernels.reference.cubemap import padded_texels
from panoless.selection.fitted import Fitted
from panoless.selection.lens import with_lens
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

OPTIONS = FreeFormOptions(
    rounds=tuple(replace(settings, rays=settings.rays // 2) for settings in DEFAULTS.rounds),
    finer=(),
    detailing=(),
    concave=ConcaveOptions(search=False),
    descent=DescentOptions(rounds=()),
    start_tensions=DEFAULTS.start_tensions[::2],
)
FEW_PIXELS = replace(
    OPTIONS,
    rounds=tuple(replace(settings, rays=8_000) for settings in OPTIONS.rounds),
    mending=tuple(replace(settings, rays=8_000) for settings in OPTIONS.mending),
    most_mendings=1,
)
COARSE = replace(OPTIONS.rounds[0], rays=5_000)
SECOND = FreeFormRound(20, 32, 0.20, 1, 20_000, 100.0, 5)
"""A round on the grid of the first, by pixels' centers."""
FIRST = FirstSurfaceOptions(hull_resolution=56)
CONFIG = replace(FitConfig(), free_form=OPTIONS, first_surface=FIRST)
VIEWS, SIZE_PX = 20, 64


def fitted(
    views: Views, options: FreeFormOptions = OPTIONS, hull: FirstSurfaceOptions = CONFIG.first_surface
) -> LevelSet:
    proposal = FreeFormFamily().propose(views, replace(CONFIG, free_form=options, first_surface=hull), asked=True)
    assert proposal is not None
    return fit_free_form(views, started(views, proposal.shape, options), options)[0]


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
    proposal = family.propose(views, CONFIG, asked=False)
    assert proposal is not None
    geometry = family.fit(views, proposal, CONFIG)
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
    """An ellipsoid with a dent where cameras face it, and what a step under a fine map believes of it."""
    body = ellipsoid()
    views = body_views(body, 12, 56)
    right = coarse_stage(views, first_surfaces(views, CONFIG).plain, FEW_PIXELS.rounds, FEW_PIXELS).surface
    camera = cameras_around(VIEWS, SIZE_PX)[VIEWS // 2]
    origin, direction = (each.mean(0, keepdims=True) for each in camera_rays_world(camera, 1))
    hit = right.hits(in_frame(views.object_frame, origin), direction / np.linalg.norm(direction))
    away = right.spacing * np.linalg.norm(right.nodes() - hit.places, axis=3)
    dent = replace(right, coefficients=right.coefficients + 1.5 * np.exp(-0.5 * (away / 0.2) ** 2))
    believed = FitStage(dent, full_trust(dent, OPTIONS.trust_cells), None, OPTIONS.damping)
    return body, views, take_round(views, believed, replace(FEW_PIXELS.rounds[-1], steps=1), FEW_PIXELS)


def test_parts_that_pixels_distrust_are_mended(dented: tuple[Body, Views, FitStage]) -> None:
    body, views, stage = dented
    cameras = cameras_around(7, 60)[1::2]
    *_, mended = mended_stages(views, stage, FEW_PIXELS)
    before, after = (normal_errors_deg(each.surface, body, views, cameras) for each in (stage, mended))
    assert after.mean() < before.mean() / 3
    assert distrusted_share(views, mended, FEW_PIXELS) < distrusted_share(views, stage, FEW_PIXELS) / 3


@pytest.mark.slow
def test_waves_narrower_than_the_first_cells_are_found_under_coarse_maps() -> None:
    """Their normals turn by 15° and more. Measured: 0.3° in the median; 8.3° without the rounds that look for them."""
    body, cameras = wavy_ball(0.03, 9.0), cameras_around(16, 64)
    short = tuple(replace(DEFAULTS.detailing[index], rays=8_000, steps=4) for index in (0, 2, 4, 5))
    options = replace(FEW_PIXELS, mending=(), detailing=short)
    views = body_views(body, len(cameras), 64)
    assert np.median(normal_errors_deg(fitted(views, options), body, views, cameras[::5])) < 0.6


def test_rounds_that_look_for_details_are_refused_where_held_out_views_gain_nothing() -> None:
    """On a ball that is explained already, and no finer round takes their cells away again."""
    views, details = body_views(sphere(), 10, 40), FreeFormRound(24, 4, 0.8, 1, 2_000, 30.0, 1)
    coarse = replace(FEW_PIXELS, rounds=(replace(COARSE, steps=2),), mending=(), detailing=(), detailed_error=-1.0)
    start = started(views, first_surfaces(views, replace(CONFIG, free_form=coarse)), coarse)
    alone, refused, taken = (
        fit_free_form(views, start, each)[0]
        for each in (
            coarse,
            replace(coarse, detailing=(details,)),
            replace(coarse, detailing=(details,), least_detailing_gain=-99.0, finer=(replace(details, cells=22),)),
        )
    )
    np.testing.assert_array_equal(refused.coefficients, alone.coefficients)
    assert (alone.cells, taken.cells) == (COARSE.cells, details.cells)


def test_what_pixels_trust_is_not_mended(dented: tuple[Body, Views, FitStage]) -> None:
    _, views, stage = dented
    trusted = replace(stage, trust=full_trust(stage.surface, FEW_PIXELS.trust_cells))
    assert list(mended_stages(views, trusted, FEW_PIXELS)) == [trusted]


@pytest.mark.slow
def test_held_out_pixels_that_miss_the_surface_are_unexplained() -> None:
    """Under one color all around, which any surface explains, the error is the share of the pixels that miss it."""
    views = body_views(sphere(), 10, 48)
    train = [replace(view, radiance=torch.full_like(view.radiance, 0.5)) for view in views.train]
    solved, tested = (replace(views, train=tuple(part)) for part in (train[:8], train[8:]))
    whole = first_surfaces(views, CONFIG).hull
    small = replace(whole, coefficients=whole.coefficients + 0.3 / whole.spacing)
    pixels = solid_pixels(tested, OPTIONS.held_out_rays)
    for surface, bare in ((whole, False), (small, True)):
        stage = FitStage(surface, full_trust(surface, OPTIONS.trust_cells), None, OPTIONS.damping)
        sights = Sights.of(surface, pixels.rays, 1, OPTIONS.least_cosine)
        inner = pixels.inner_px > OPTIONS.inner_px
        missed, clear = (inner & ~sights.hits.met).sum(), (inner & sights.clear).sum()
        assert (missed > 0.2 * clear) == bare
        assert held_out_error(solved, tested, stage, OPTIONS) == pytest.approx(missed / (missed + clear), abs=1e-3)


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
def solution() -> Solution:
    """A wavy ball between two rounds."""
    views = with_pose_covariances(body_views(wavy_ball(), 12, 60), np.tile(1e-4 * np.eye(6), (12, 1, 1)))
    options = replace(OPTIONS, rounds=OPTIONS.rounds[:1])
    surface = fitted(views, options)
    return Solution.at(make_task(views, SECOND, options), surface, full_trust(surface, 20), None, 2)


def test_a_step_with_the_map_made_anew_gains_what_its_equations_promise(solution: Solution) -> None:
    step = gauss_newton_step(solution, 1e-3).coefficients
    promised = -float((step * solution.gradient()[0]).sum()) - float((step * solution.product(step)[0]).sum()) / 2
    surface = replace(solution.surface, coefficients=solution.surface.coefficients + step)
    moved = Solution.at(solution.task, surface, solution.trust, solution.environment, 3)
    gained = solution.cost(solution) - moved.cost(solution)
    assert promised > 0
    assert 0.4 < gained / promised < 1.6


def test_the_gradient_is_that_of_finite_differences(solution: Solution) -> None:
    """Of outlines and gauge; outlines near to zero hardly feel the slope that their distances are divided by."""
    parts = solution.silhouettes, solution.gauge
    gradient = sum(rows.backward(rows.residual, solution.surface.shape) for rows in parts) * solution.active
    change, costs = 1e-3 * gradient / np.abs(gradient).max(), []
    for sign in (-1, 1):
        surface = replace(solution.surface, coefficients=solution.surface.coefficients + sign * change)
        moved = replace(solution, surface=surface)
        costs.append(moved.silhouettes.cost + moved.gauge.cost)
    assert (costs[1] - costs[0]) / 2 == pytest.approx(float((gradient * change).sum()), rel=0.02)


def test_smoothness_of_an_anchored_round_is_asked_of_the_change_alone(solution: Solution) -> None:
    coefficients = solution.surface.coefficients
    anchored = replace(solution, task=replace(solution.task, anchor=coefficients))
    assert np.abs(anchored.bent).max() == 0
    np.testing.assert_allclose(
        solution.gradient()[0] - anchored.gradient()[0], solution.bent * solution.active, atol=1e-9
    )
    free = replace(solution, task=replace(solution.task, anchor=np.zeros_like(coefficients)))
    np.testing.assert_array_equal(free.bent, solution.bent)
    assert anchored.cost(anchored) < solution.cost(solution) == free.cost(free)


@pytest.mark.parametrize("cells", [-1.0, 1.0])
def test_a_step_that_moves_all_of_the_surface_alike_costs_no_smoothness(solution: Solution, cells: float) -> None:
    """Third differences of a constant are zero; coefficients that come near the surface have not been smoothed yet."""
    moved = replace(solution, surface=replace(solution.surface, coefficients=solution.surface.coefficients + cells))
    assert (moved.active & ~solution.active).any()
    assert moved.prior(solution) == pytest.approx(solution.prior(solution), rel=1e-9)
    assert moved.prior(moved) != pytest.approx(solution.prior(solution), rel=0.1)


def test_a_round_by_outlines_alone_does_not_feel_photographs(solution: Solution) -> None:
    """Its step is the same under any map, and finite where no texel has a vote."""
    settings = replace(solution.task.settings, outlines_alone=True)
    task = replace(solution.task, settings=settings, photograph_weight=0.0)
    blind = Solution.at(task, solution.surface, solution.trust, None, 1, Poses.none(12))
    other = replace(blind, residual=blind.residual[::-1] + 1, slopes=2 * blind.slopes)
    one, two = (gauss_newton_step(each, 1e-3) for each in (blind, other))
    assert np.isfinite(one.coefficients).all()
    assert np.abs(one.beside[0]).max() > 0
    np.testing.assert_array_equal(one.coefficients, two.coefficients)
    np.testing.assert_array_equal(one.beside[0], two.beside[0])


def test_beside_photographs_outlines_move_no_poses(solution: Solution) -> None:
    """They move the surface all the same, and poses in rounds of their own."""
    free = replace(solution, poses=Poses.none(12))
    seen = free.gradient()[1][0]
    outlined = replace(free, task=replace(free.task, outline_weight=2 * free.task.outline_weight))
    np.testing.assert_allclose(outlined.gradient()[1][0], seen, rtol=1e-9, atol=1e-9 * np.abs(seen).max())
    assert np.abs(outlined.gradient()[0] - free.gradient()[0]).max() > 0
    settings = replace(free.task.settings, outlines_alone=True)
    alone = [replace(each, task=replace(each.task, settings=settings)) for each in (free, outlined)]
    assert np.abs(alone[0].gradient()[1][0] - alone[1].gradient()[1][0]).max() > 1e-3 * np.abs(seen).max()


def with_waves(surface: LevelSet) -> LevelSet:
    waves = 4 * np.sin(0.5 * np.arange(surface.shape[0]))[:, None, None]
    return replace(surface, coefficients=surface.coefficients + waves)


@pytest.mark.slow
def test_a_start_that_descended_is_taken_where_pixels_agree_better() -> None:
    """Not the plain surface with waves but what a plate or the hull leads to; the plain one where no gain is enough."""
    views = body_views(sphere(), 8, 32)
    proposal = FreeFormFamily().propose(views, CONFIG, asked=True)
    assert proposal is not None
    right, one = proposal.shape.surface, FreeFormRound(12, 4, 0.5, 1, 500, 100.0, 1, anchored=True)
    options = replace(OPTIONS, rounds=(replace(one, anchored=False),), descent=DescentOptions(rounds=(one,)))
    wrong = with_waves(right)
    assert started(views, FirstSurfaces(wrong, wrong, (right,)), options).cells == one.cells
    assert started(views, FirstSurfaces(wrong, right, (wrong,)), options).cells == one.cells
    never = replace(options, descent=replace(options.descent, least_gain=1.0))
    assert started(views, FirstSurfaces(right, right, (wrong,)), never).cells == right.cells


def test_the_plain_surface_descends_alone_where_pixels_agree_on_it() -> None:
    """Held by outlines; where any disagreement is little enough, a ball that is at hand is not asked."""
    views = body_views(sphere(), 8, 32)
    right = first_surfaces(views, CONFIG).plain
    wrong = with_waves(right)
    one = FreeFormRound(12, 4, 0.5, 1, 500, 100.0, 1, anchored=True)
    content = DescentOptions(rounds=(one,), least_disagreement=np.inf, least_gain=-np.inf)
    options = replace(OPTIONS, rounds=(replace(one, anchored=False),), descent=content)
    held = coarse_stage(views, wrong, [replace(one, held=True)], options).surface
    found = started(views, FirstSurfaces(wrong, right, (right,)), options)
    np.testing.assert_array_equal(found.coefficients, held.coefficients)


def test_the_matrix_is_symmetric_and_positive(solution: Solution) -> None:
    rng = np.random.default_rng(1)
    one, other = (rng.normal(size=solution.surface.shape) * solution.active for _ in range(2))
    assert (one * solution.product(other)[0]).sum() == pytest.approx((other * solution.product(one)[0]).sum(), rel=1e-6)
    assert (one * solution.product(one)[0]).sum() > 0


@pytest.mark.slow
def test_held_out_views_refuse_cells_that_a_ball_does_not_need() -> None:
    """Two more rounds are offered, and the one with a rough surface is not taken."""
    rough = FreeFormRound(34, 32, 0.15, 1, 10_000, 1e-6, 2)
    options = replace(OPTIONS, rounds=(COARSE, replace(SECOND, rays=5_000)), finer=(rough,))
    views = body_views(sphere(), 10, 40)
    surface = fitted(views, options)
    assert max(surface.shape) < 34


@pytest.mark.slow
def test_the_same_views_give_the_same_surface() -> None:
    """A killed fit in closed form starts again, so it ends where the other would have."""
    views = body_views(sphere(), 8, 32)
    options, hull = (
        replace(OPTIONS, rounds=(replace(COARSE, cells=14, steps=2),)),
        FirstSurfaceOptions(hull_resolution=28),
    )
    one, other = (fitted(views, options, hull) for _ in range(2))
    np.testing.assert_array_equal(one.coefficients, other.coefficients)


def test_the_kind_keeps_the_protocol(ring: tuple[Views, FreeFormMirror]) -> None:
    """State, rays, buffers, light, mesh and surfels of one fit."""
    views, geometry = ring
    again = FreeFormMirror.from_state_dict(geometry.state_dict())
    np.testing.assert_array_equal(again.surface.coefficients, geometry.surface.coefficients)
    np.testing.assert_array_equal(again.trust.values, geometry.trust.values)
    assert again.options == geometry.options
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


@pytest.mark.parametrize("unknown", ["poses", LensChange(focal=0.0), LensChange(k1=0.0)])
def test_the_gradient_beside_the_surface_is_that_of_finite_differences(
    solution: Solution, unknown: str | LensChange
) -> None:
    """Of photographs under a map and on a surface that stay, and of outlines."""
    if isinstance(unknown, str):
        moved = replace(solution, poses=Poses.none(12))
        change = 1e-5 * np.random.default_rng(0).normal(size=(12, 6))
        sides = [replace(moved, poses=moved.poses.after(sign * change)) for sign in (1, -1)]
    else:
        moved, change = replace(solution, lens=unknown), np.full((1, 1), 1e-5)
        sides = [replace(moved, lens=unknown.after(sign * change[0])) for sign in (1, -1)]
    photographs, outlines = (
        moved.pose_rows if unknown == "poses" else (moved.beside[0].photographs, moved.beside[0].silhouettes)
    )
    options, clear, seen = solution.task.options, moved.sights.clear, []
    length = solution.environment.shape[-1] + 2
    padded = padded_texels(solution.environment).reshape(6, length, length, 3).double().numpy()
    for side in sides:
        sights = Sights.of(solution.surface, side.rays, solution.task.settings.samples, options.least_cosine)
        clear = clear & sights.clear
        seen.append(seen_with_slopes(padded, sights.outgoing)[0])
    expected = ((seen[0] - seen[1]) / 2 * moved.gain[:, None])[clear]
    found = photographs.forward(change)[clear & (photographs.weights > 0)]
    expected = expected[(photographs.weights > 0)[clear]]
    assert np.median(np.abs(found - expected)) < 0.01 * np.median(np.abs(expected))
    count = len(solution.task.outlines.size)
    expected = ((sides[0].silhouettes.residual - sides[1].silhouettes.residual) / 2)[:count]
    found = outlines.forward(change)[:count]
    assert np.median(np.abs(found - expected)) < 0.01 * np.median(np.abs(expected))


def test_the_matrix_with_all_unknowns_is_symmetric(solution: Solution) -> None:
    """Poses, surroundings and lens beside the surface."""
    near = replace(solution.surface, surroundings=Surroundings(np.array([0.1, 0.02, 0.0, 0.01])))
    moved = replace(solution, surface=near, poses=Poses.none(12), lens=LensChange(0.01, 0.02))
    sizes = moved.surface.shape, (12, 6), (1, 6)
    rng = np.random.default_rng(1)
    one, other = (([rng.normal(size=size) for size in sizes]) for _ in range(2))

    def dot(first: list[np.ndarray], second: list[np.ndarray]) -> float:
        change, beside = moved.product(second[0] * moved.active, second[1:])
        ahead = [change, *beside]
        return float(sum((a * b).sum() for a, b in zip([first[0] * moved.active, *first[1:]], ahead, strict=True)))

    assert dot(one, other) == pytest.approx(dot(other, one), rel=1e-6)
    assert dot(one, one) > 0


def test_a_refused_step_is_tried_again_with_more_damping(solution: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is refused below a damping of 0.06, a round goes on until that is reached, and then moves."""
    tried: list[float] = []

    def step(solution: Solution, damping: float, **_: bool) -> Change:
        tried.append(damping)
        found = gauss_newton_step(solution, damping)
        return found if damping > 0.06 else replace(found, coefficients=-100 * found.coefficients)

    monkeypatch.setattr(fit, "gauss_newton_step", step)
    settings = replace(solution.task.settings, steps=3)
    moved, _ = fit.take_steps(replace(solution, task=replace(solution.task, settings=settings)), 1e-3)
    assert tried[0] == 1e-3
    assert tried[1] > 0.06
    assert moved.cost(solution) < solution.cost(solution)


@pytest.mark.slow
def test_a_wrong_focal_length_is_found_beside_the_shape() -> None:
    """Of a wavy ball through a lens that is said to be 2 % longer than it is: within a quarter of that, in as many
    rounds as held-out views want. The surface of the wrong lens is 2 % too small, and what comes back belongs to the
    right one.
    """
    views = body_views(wavy_ball(), 16, 80)
    wrong = replace(views, train=tuple(with_focal_factor(view, 1.02) for view in views.train))
    family = FreeFormFamily()
    proposal = family.propose(wrong, CONFIG, asked=False)
    assert proposal is not None
    first = family.fit(wrong, proposal, CONFIG)
    found = with_lens(wrong, Fitted(first, PosedProposal(proposal)), CONFIG, lambda *_, anew: None)
    assert found.corrections.focal_factor == pytest.approx(1 / 1.02, abs=0.25 * 0.02)
    geometry = found.geometry
    before, after = (np.abs(wavy_ball().value(each.mesh(views.object_frame).vertices)) for each in (first, geometry))
    assert np.median(after) < 0.3 * np.median(before)


@pytest.mark.slow
def test_a_lens_that_is_right_is_believed_at_a_glance() -> None:
    """Of a wavy ball: a distortion within 0.03, and a focal length within 0.6 %."""
    views = body_views(wavy_ball(), 16, 80)
    family = FreeFormFamily()
    proposal = family.propose(views, CONFIG, asked=False)
    assert proposal is not None
    _, change = family.with_lens(views, family.fit(views, proposal, CONFIG), LensChange(0.0, 0.0), CONFIG)
    assert change.k1 == pytest.approx(0, abs=0.03)
    assert change.focal == pytest.approx(0, abs=0.006)


@pytest.mark.slow
def test_flat_faces_that_no_outline_shows_are_found_by_a_descent() -> None:
    """The corner of a block faces the cameras. By the median of normals a start that descended is wrong by 1.6°, the
    plain one by 22°.
    """
    views = body_views(block(), VIEWS, SIZE_PX)
    proposal = FreeFormFamily().propose(views, CONFIG, asked=True)
    assert proposal is not None

    def error_deg(options: FreeFormOptions) -> float:
        start = started(views, proposal.shape, options)
        return float(np.median(normal_errors_deg(start, block(), views, cameras_around(7, 60)[1::2])))

    assert error_deg(replace(OPTIONS, descent=DescentOptions())) < 3.0 < 12.0 < error_deg(OPTIONS)


@pytest.mark.slow
def test_outlines_hold_faces_that_maps_of_few_texels_would_turn() -> None:
    """After two rounds of the descent from a rounded plate, by the mean of normals: 3.3° held, 17° by pixels alone."""
    body = block(exponent=10.0)
    views = body_views(body, 16, 56)
    config = replace(CONFIG, free_form=replace(OPTIONS, start_tensions=DEFAULTS.start_tensions))
    proposal = FreeFormFamily().propose(views, config, asked=True)
    assert proposal is not None
    first = proposal.shape.plates[1]

    def error_deg(*, held: bool) -> float:
        rounds = [replace(each, held=held) for each in DescentOptions().rounds[:2]]
        with torch.no_grad():
            surface = coarse_stage(views, first, rounds, OPTIONS).surface
        return float(np.mean(normal_errors_deg(surface, body, views, cameras_around(7, 60)[1::2])))

    assert error_deg(held=True) < 4.0 < 12.0 < error_deg(held=False)


@pytest.mark.slow
def test_flat_faces_that_mirror_a_dark_ground_are_found() -> None:
    """The median brightness is a tenth of the mean. 0.5° are measured as logarithms and 0.6° as radiance; 41° in a
    descent by pixels alone.
    """
    views = body_views(block(), VIEWS, SIZE_PX)
    dark = replace(views, train=tuple(replace(view, radiance=5 * view.radiance**16) for view in views.train))
    config = replace(CONFIG, free_form=replace(OPTIONS, descent=DescentOptions()))

    def error_deg(config: FitConfig) -> float:
        family = FreeFormFamily()
        surface = family.fit(dark, family.propose(dark, config, asked=True), config).surface
        return float(np.median(normal_errors_deg(surface, block(), dark, cameras_around(7, 60)[1::2])))

    assert error_deg(config) < 1.0
    assert error_deg(replace(config, contrast=ContrastOptions(dark_share=0.0))) < 1.0


def test_a_fit_goes_on_in_the_contrast_of_its_photographs() -> None:
    """From a surface that was fitted to logarithms, by these and not by radiance."""
    views, family, contrast = body_views(ellipsoid(), 8, 32), FreeFormFamily(), Contrast(0.05)
    start = family.propose(views, CONFIG, asked=True)
    plain = family.as_proposed(start, CONFIG)

    def onward(views: Views, contrast: Contrast) -> FreeFormMirror:
        return family.fit(views, replace(start, fitted=replace(plain, contrast=contrast)), CONFIG)

    by_radiance, by_logarithms = onward(views, Contrast()), onward(views, contrast)
    assert by_logarithms.contrast == contrast
    expected = onward(contrast.applied(views), Contrast())
    assert np.array_equal(by_logarithms.surface.coefficients, expected.surface.coefficients)
    assert not np.array_equal(by_logarithms.surface.coefficients, by_radiance.surface.coefficients)


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


@pytest.mark.parametrize("wrong", ["turns", "shifts"])
def test_what_cameras_were_not_wrong_about_tells_where_the_world_is(wrong: str) -> None:
    """What is wrong by chance has a mean, too, and that of 30 cameras turns and shifts the world."""
    rng, size = np.random.default_rng(2), {"turns": np.radians(0.5), "shifts": 0.01}[wrong]
    stated = StatedCameras.of(body_views(wavy_ball(), 30, 20))
    found = replace(Poses.none(30), **{wrong: size * rng.normal(size=(30, 3))})
    prior = stated.prior(np.radians(1.0), 0.02, 0.1)
    kept = "shifts" if wrong == "turns" else "turns"
    left = [found.without_common(stated, each)[1] for each in (prior, found.likely_prior(stated, prior, 0.01))]
    moved = [np.abs(getattr(poses, kept)).max() for poses in left]
    assert moved[1] < 0.2 * moved[0]


def test_poses_beyond_others_lead_from_these_to_them() -> None:
    first, second = (Poses(*np.random.default_rng(seed).normal(size=(2, 5, 3))) for seed in (0, 1))
    both = first.after(second.beyond(first).stacked)
    apart = (Rotation.from_rotvec(both.turns) * Rotation.from_rotvec(second.turns).inv()).magnitude()
    np.testing.assert_allclose(apart, 0, atol=1e-12)
    np.testing.assert_allclose(both.shifts, second.shifts, atol=1e-12)


def turned_by(views: Views, degrees: float, seed: int) -> Poses:
    """Turns by that much, each about an axis of its own."""
    axes = np.random.default_rng(seed).normal(size=(len(views.train), 3))
    turns = np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Poses(turns, np.zeros_like(turns))


def left_deg(found: Poses, wrong: Poses) -> float:
    """The median of what is left of turns, but for what all cameras share."""
    left = Rotation.from_rotvec(found.turns) * Rotation.from_rotvec(wrong.turns)
    return float(np.degrees(np.median((left.mean().inv() * left).magnitude())))


@pytest.mark.slow
@pytest.mark.parametrize("body", [ellipsoid(), block()], ids=["ellipsoid", "block"])
def test_outlines_tell_cameras_that_are_turned_by_two_degrees(body: Body) -> None:
    """These miss the hull of all views by a fifth of the object's radius, and no plate between its contacts is left."""
    views, family = body_views(body, 30, SIZE_PX), FreeFormFamily()
    wrong = turned_by(views, 2.0, 3)
    seen = wrong.moved(views)
    start = align_proposal(family, seen, family.propose(seen, CONFIG, asked=True), CONFIG)
    assert start is not None
    assert start.poses is not None
    assert left_deg(start.poses, wrong) < 0.5


def test_photographs_agree_with_masks_unless_outlines_lie_to_one_side_of_them(solution: Solution) -> None:
    """A surface that is larger by 0.05 px is as near to the masks as theirs may be, but not as one that they tell."""

    def apart_px(moved: Solution) -> float:
        return float(np.median(moved.silhouettes.residual[: len(moved.task.outlines.view)]))

    def larger(cells: float) -> Solution:
        surface = replace(solution.surface, coefficients=solution.surface.coefficients - cells)
        return replace(solution, surface=surface)

    cells_a_pixel = 0.01 / (apart_px(larger(0.0)) - apart_px(larger(0.01)))
    level = apart_px(solution) * cells_a_pixel
    assert larger(level).outlines_agree
    for off_px in (-0.2, -0.05, 0.05, 0.2):
        assert not larger(level + off_px * cells_a_pixel).outlines_agree


def test_rays_that_pass_the_box_of_a_surface_cost_as_outliers(ring: tuple[Views, FreeFormMirror]) -> None:
    """So a camera that turns away from the object gains nothing."""
    views, geometry = ring
    away = turned_by(views, 60.0, 0)
    outlines = outline_rays(views)
    costs = [
        silhouette_rows(geometry.surface, rays, rays.chosen(slice(0)), 1.0, 1.0, DEFAULTS)[0].cost
        for rays in (outlines, outlines.moved(away))
    ]
    assert costs[1] > 10 * costs[0]
    assert costs[1] > 0.49 * len(outlines.size) * DEFAULTS.outline_scale_px**2


@pytest.fixture(scope="module", params=[wavy_ball(), torus()], ids=["ball", "ring"])
def turned(request: pytest.FixtureRequest) -> tuple[Body, Views, Poses, Geometry]:
    """A body seen by cameras that are turned by half a degree, how they are turned, and what was fitted."""
    body, count, family = request.param, 25, FreeFormFamily()
    views = body_views(body, count, 80)
    poses = turned_by(views, 0.5, 1)
    seen = poses.moved(views)
    start = align_proposal(family, seen, family.propose(seen, CONFIG, asked=True), CONFIG)
    assert start is not None
    geometry = fit_with_poses(family, family, seen, start, CONFIG)
    assert geometry is not None
    return body, views, poses, geometry


@pytest.mark.slow
def test_cameras_that_are_turned_by_half_a_degree_are_found(
    turned: tuple[Body, Views, Poses, Geometry], request: pytest.FixtureRequest
) -> None:
    """Outlines tell all of them but for what a round body hides, its roll, and photographs tell that. True cameras are
    left alone by outlines.
    """
    _, views, wrong, geometry = turned
    if "ring" in request.node.name:
        request.applymarker(pytest.mark.xfail(reason="of a ring of 80 pixels 0.09° are left"))
    assert left_deg(geometry.poses, wrong) < 0.05
    family = FreeFormFamily()
    assert align_proposal(family, views, family.propose(views, CONFIG, asked=True), CONFIG) is None


@pytest.mark.slow
@pytest.mark.xfail(reason="0.22° on the ball and 1.6° on the ring, in pictures of 80 pixels")
def test_a_surface_under_cameras_that_were_found_is_nearly_as_good(turned: tuple[Body, Views, Poses, Geometry]) -> None:
    """As from true cameras, but for a turn of the world."""
    body, views, _, geometry = turned
    errors = normal_errors_deg(geometry.surface, body, views, cameras_around(7, 60)[1::2])
    assert np.median(errors) < 0.2
