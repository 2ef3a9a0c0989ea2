"""What training views say about a fit: figures with known values, and the verdict that follows from them."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import max_pool2d, normalize

from panoless.capture.views import TrainView, Views
from panoless.config import EnvironmentConfig, FitConfig
from panoless.environment.footprints import Footprints, PixelFootprints
from panoless.environment.material_field import MaterialField
from panoless.environment.reflectance import Reflectance
from panoless.geometry.plane.kind import PlaneMirror
from panoless.kernels.cubemap import cubemap_directions
from panoless.trust.evidence import VIEWED_WITHIN_RAD, Evidence, gather_evidence
from panoless.trust.verdict import AROUND, LARGEST_MISSED, LARGEST_SURPLUS, MASKS, MATTER, POSES, SHINE, TEXTURE, judge
from tests.support.mirror_plane import RECTANGLE, arc, plane_of, reflecting_views

CONFIG = FitConfig(environment=EnvironmentConfig(solve_resolution=32))
MIRROR = PlaneMirror(plane_of(RECTANGLE))
VISIBILITY = torch.linspace(0.1, 1.0, 6 * 32 * 32).reshape(6, 32, 32)


@pytest.fixture(scope="module")
def views() -> Views:
    return reflecting_views(plane_of(RECTANGLE), arc(15, size=64))


def evidence(views: Views) -> Evidence:
    return gather_evidence(views, MIRROR, VISIBILITY, CONFIG)


@pytest.fixture(scope="module")
def clean(views: Views) -> Evidence:
    """Of the views as they are."""
    return evidence(views)


def each(views: Views, change) -> Views:
    return replace(views, train=tuple(change(index, view) for index, view in enumerate(views.train)))


def turned(view: TrainView, vector_deg: list[float]) -> TrainView:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(vector_deg)).as_matrix()
    pose = torch.from_numpy(turn).float() @ view.camera.world_to_camera
    return replace(view, camera=replace(view.camera, world_to_camera=pose))


def test_the_true_mirror_is_trusted(clean: Evidence) -> None:
    """It leaves a third of what one color a view or a place leaves, or less, and its silhouette is the mask's."""
    found = clean
    assert found.unexplained is not None
    assert found.one_color is not None
    assert found.matte is not None
    assert found.unexplained < min(found.one_color, found.matte) / 3
    assert found.silhouette_px < 0.05
    assert found.view_shift_px < 0.05
    assert found.overlap > 0.99
    assert (found.views, found.coverage) == (15, 1.0)
    assert judge(found).verdict == "trust"


def test_the_share_of_places_that_are_not_explained_is_measured_and_named(views: Views, clean: Evidence) -> None:
    """The right half of each picture shows anything, as a part does whose shape is wrong."""

    def half_wrong(index: int, view: TrainView) -> TrainView:
        column = view.solid % view.camera.width
        right = view.solid[column > column.float().median()]
        colors = view.radiance.flatten(1).clone()
        generator = torch.Generator().manual_seed(index)
        colors[:, right] = torch.rand((3, len(right)), generator=generator).round()
        return replace(view, radiance=colors.reshape(view.radiance.shape))

    mixed = evidence(each(views, half_wrong))
    assert clean.unexplained_part is not None
    assert mixed.unexplained_part is not None
    assert clean.unexplained_part < 0.02
    assert 0.3 < mixed.unexplained_part < 0.7
    verdict = judge(replace(mixed, unexplained=0.0))
    assert verdict.verdict == "do not trust"
    assert "lies where its shape explains little of it" in verdict.reason


def test_what_the_shape_leaves_bare_is_measured_and_named(views: Views, clean: Evidence) -> None:
    """A corner of each picture that masks show and the shape lacks, but not the edge of masks that are too large."""

    def with_a_corner(index: int, view: TrainView) -> TrainView:
        mask = view.mask.clone()
        mask[: mask.shape[0] // 3, : mask.shape[1] // 3] = 1
        return replace(view, mask=mask)

    def wider(index: int, view: TrainView) -> TrainView:
        return replace(view, mask=max_pool2d(view.mask[None], 5, 1, 2)[0])

    bare = evidence(each(views, with_a_corner))
    assert clean.missed == evidence(each(views, wider)).missed == 0
    assert bare.missed > LARGEST_MISSED
    verdict = judge(replace(bare, silhouette_px=0.0, view_shift_px=0.0))
    assert verdict.verdict != "trust"
    assert "bare" in verdict.reason


def test_what_the_shape_has_too_much_is_measured_and_named(views: Views, clean: Evidence) -> None:
    """A quarter of each mask that is cut off, far from which the shape goes on; but not the edge of masks too small."""

    def cut(index: int, view: TrainView) -> TrainView:
        mask = view.mask.clone()
        columns = torch.nonzero((mask > 0.5).any(0))[:, 0]
        mask[:, columns[-len(columns) // 4] :] = 0
        return replace(view, mask=mask)

    def narrower(index: int, view: TrainView) -> TrainView:
        return replace(view, mask=1 - max_pool2d(1 - view.mask[None], 3, 1, 1)[0])

    grown = evidence(each(views, cut))
    assert clean.surplus == evidence(each(views, narrower)).surplus == 0
    covered = [
        float((turn.mask > 0.5).sum() / (view.mask > 0.5).sum())
        for turn, view in zip(views.train, each(views, cut).train, strict=True)
    ]
    assert LARGEST_SURPLUS < grown.surplus < np.mean(covered) - 1
    verdict = judge(replace(grown, silhouette_px=0.0, view_shift_px=0.0))
    assert verdict.verdict != "trust"
    assert "outside the masks" in verdict.reason


def test_a_mirror_that_fills_all_pictures_misses_no_silhouette() -> None:
    """Its silhouette lies outside of them; what a smaller one leaves bare of them is still missed."""
    wide = plane_of(10 * RECTANGLE)
    views = reflecting_views(wide, arc(6, 20.0, size=32))
    assert all(view.mask.min() == 1 for view in views.train)
    found, bare = (gather_evidence(views, PlaneMirror(each), VISIBILITY, CONFIG) for each in (wide, MIRROR.plane))
    assert (found.silhouette_px, found.view_shift_px, found.missed) == (0, 0, 0)
    assert 0.3 < bare.missed < 1


def test_turned_cameras_are_measured_and_named(views: Views) -> None:
    """A turn of 1.5° about the horizontal axis, up and down in turn, shifts each silhouette by that angle; a verdict
    says so.
    """
    found = evidence(each(views, lambda i, view: turned(view, [1.5 * (-1) ** i, 0, 0])))
    assert found.view_shift_deg == pytest.approx(1.5, rel=0.1)
    focal = np.array([view.camera.fx for view in views.train])
    assert found.view_shift_px == pytest.approx(np.tan(np.radians(1.5)) * np.sqrt((focal**2).mean()), rel=0.1)
    verdict = judge(found)
    assert verdict.verdict == "do not trust"
    assert (verdict.remedy, "wrong poses" in verdict.reason) == (POSES, True)


def test_a_matte_object_is_told_from_a_mirror(views: Views) -> None:
    """Where each place on the surface has its own color in all views, that explains them and a mirror does not."""

    def painted(_: int, view: TrainView) -> TrainView:
        surface = MIRROR.buffers(view.camera)
        rays = view.rays_camera
        points_camera = (rays / rays[2] * surface.depth).flatten(1) - view.camera.world_to_camera[:3, 3:]
        points = view.camera_to_world_rotation @ points_camera
        color = 0.5 + 0.5 * torch.sin(6 * points).reshape(rays.shape)
        return replace(view, radiance=color * view.mask)

    found = evidence(each(views, painted))
    assert found.matte is not None
    assert found.unexplained is not None
    assert found.matte < 0.2 * found.unexplained
    verdict = judge(found)
    assert (verdict.verdict, verdict.remedy) == ("do not trust", MATTER)


def test_noise_and_saturation_are_measured(views: Views) -> None:
    """Gray pictures with noise of a known deviation; and pictures a quarter of whose pixels end at one."""
    generator = torch.Generator().manual_seed(0)

    def gray(_: int, view: TrainView) -> TrainView:
        return replace(view, radiance=0.5 + 0.04 * torch.randn(view.radiance.shape, generator=generator))

    found = evidence(each(views, gray))
    assert found.noise == pytest.approx(0.04, rel=0.05)
    assert found.error_in_noise == pytest.approx(0.6745, rel=0.15)
    assert found.saturated == 0

    def bright(index: int, view: TrainView) -> TrainView:
        radiance = view.radiance.clone().clamp(max=0.9).flatten(1)
        radiance[1, view.solid[::4]] = 1.0
        return replace(view, radiance=radiance.reshape(view.radiance.shape))

    assert evidence(each(views, bright)).saturated == pytest.approx(0.25, abs=0.001)


def test_gold_is_judged_by_where_its_channels_end(views: Views) -> None:
    """A golden mirror of a brighter world, divided by its color: blue goes beyond 1 and is no more saturated, nor less
    explained, than it would be of a perfect mirror; pixels of whose channels one ends are.
    """
    gold = (1.0, 0.8, 0.34)
    largest = 1 / torch.tensor(gold)[:, None, None]
    shown = each(views, lambda _, view: replace(view, radiance=torch.minimum(1.7 * view.radiance, largest)))
    found = gather_evidence(shown, MIRROR, VISIBILITY, replace(CONFIG, tint=gold))
    ends = [(view.radiance_at(view.solid) >= 0.998 * largest[:, 0, 0]).any(1) for view in shown.train]
    assert 0 < found.saturated == pytest.approx(float(torch.cat(ends).float().mean()))
    of_no_color = evidence(shown)
    assert of_no_color.saturated > found.saturated + 0.05
    assert found.unexplained is not None
    assert of_no_color.unexplained is not None
    assert found.unexplained < of_no_color.unexplained / 3


def test_where_places_differ_residuals_count_by_the_share_that_they_mirror(views: Views) -> None:
    """Noise of photographs that was divided by a quarter, with a material that mirrors a quarter, is what it was."""
    rng, vertices = np.random.default_rng(0), np.arange(9**3)
    field = MaterialField(8, vertices, np.full((len(vertices), 3), -0.75), np.zeros((len(vertices), 3)))
    dim = Reflectance(np.ones(3), field=field)
    noise = [torch.from_numpy(rng.normal(scale=0.05, size=view.radiance.shape)).float() for view in views.train]
    of_mirror, of_dim = (
        each(views, lambda index, view, factor=factor: replace(view, radiance=view.radiance + factor * noise[index]))
        for factor in (1, 4)
    )
    expected, wrong = evidence(of_mirror).unexplained, evidence(of_dim).unexplained
    found = gather_evidence(of_dim, MIRROR, VISIBILITY, CONFIG, reflectance=dim).unexplained
    assert expected is not None
    assert wrong is not None
    assert found == pytest.approx(expected, rel=0.25)
    assert wrong > 2 * expected


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views_to_hold_one_out_are_said_to_be_so(views: Views, count: int) -> None:
    found = evidence(replace(views, train=views.train[:count]))
    assert found.unexplained is None
    verdict = judge(found)
    assert verdict.verdict == "do not trust"
    assert f"{count} usable view" in verdict.reason
    assert all(np.isfinite(value) for value in verdict.evidence.values())


def test_a_surface_that_no_view_shows_is_not_put_down_to_the_number_of_views(views: Views) -> None:
    """Photographs that can be judged, and a mirror so small that it covers no whole pixel."""
    tiny = PlaneMirror(plane_of(1e-4 * RECTANGLE))
    found = gather_evidence(views, tiny, VISIBILITY, CONFIG)
    verdict = judge(found)
    assert found.unexplained is None
    assert (verdict.verdict, verdict.remedy) == ("do not trust", MASKS)


def test_views_without_the_object_count_for_nothing(views: Views) -> None:
    """The evidence is that of the other views alone."""

    def emptied(index: int, view: TrainView) -> TrainView:
        if index % 2:
            return view
        return replace(view, mask=view.mask * 0, radiance=view.radiance * 0, solid=view.solid[:0])

    found = evidence(each(views, emptied))
    assert found.views == 7
    assert vars(found) == pytest.approx(vars(evidence(replace(views, train=views.train[1::2]))))


@pytest.mark.parametrize("figure", ["unexplained", "view_shift_px", "silhouette_px", "saturated"])
def test_no_worse_figure_lowers_the_risk(clean: Evidence, figure: str) -> None:
    risks = []
    for value in np.linspace(0, 2, 11):
        risks.append(judge(replace(clean, **{figure: float(value)})).risk)
    assert risks == sorted(risks)
    assert risks[-1] > 1


@pytest.mark.parametrize("radiance", [0.0, 0.4])
def test_photographs_of_one_color_tell_nothing(views: Views, radiance: float) -> None:
    found = evidence(each(views, lambda _, view: replace(view, radiance=torch.full_like(view.radiance, radiance))))
    verdict = judge(found)
    assert verdict.verdict == "do not trust"
    assert verdict.remedy == TEXTURE


def test_a_verdict_holds_every_figure_by_name(clean: Evidence) -> None:
    of_balls = {"rim_px", "agreement"}
    assert set(judge(clean).evidence) == {field.name for field in fields(Evidence)} - of_balls


def test_a_rough_mirror_is_not_trusted(views: Views) -> None:
    """With the roughness that the fit found, however well its views are explained."""
    found = gather_evidence(views, MIRROR, VISIBILITY, CONFIG, roughness=0.16)
    verdict = judge(found)
    assert (verdict.verdict, verdict.remedy) == ("partly", SHINE)
    assert "roughness of 0.16" in verdict.reason


class BlurringMirror(PlaneMirror):
    """A flat mirror every other pixel of which is a mean over eleven degrees each way."""

    def footprints(self, views: Views, max_pixels: int) -> Footprints:
        return Footprints([blurred_pixels(view) for view in views.train], lambda: [blurred_pixels(views.train[0])])


def blurred_pixels(view: TrainView) -> PixelFootprints:
    rays = MIRROR.observe(view, view.solid)
    width = torch.where(view.solid % 2 == 0, 0.1, 0.002)[:, None]
    across = width * normalize(torch.linalg.cross(rays.directions, torch.tensor([[0.3, 0.5, 0.8]])))
    other = torch.linalg.cross(rays.directions, across)
    corners = [rays.directions + one * across + two * other for one in (-1, 1) for two in (-1, 1)]
    return PixelFootprints(normalize(torch.stack(corners, 1), dim=2), rays.radiance)


def test_what_pixels_blur_is_not_unexplained(views: Views) -> None:
    """No map of their centers explains pixels that see a place sharply and as a mean; one of their areas does."""
    world = (0.5 + 0.4 * torch.sin(10 * cubemap_directions(64))).permute(0, 3, 1, 2)

    def blurred(_: int, view: TrainView) -> TrainView:
        colors = torch.zeros_like(view.radiance).flatten(1)
        colors[:, view.solid] = blurred_pixels(view).seen(world.contiguous()).T
        return replace(view, radiance=colors.reshape(view.radiance.shape))

    photographs, areas = each(views, blurred), BlurringMirror(MIRROR.plane)
    by_area, by_center = (gather_evidence(photographs, mirror, VISIBILITY, CONFIG) for mirror in (areas, MIRROR))
    assert by_area.unexplained is not None
    assert by_center.unexplained is not None
    assert by_area.unexplained < 0.5 * by_center.unexplained


def test_views_from_one_place_are_doubted_however_well_they_agree(views: Views, clean: Evidence) -> None:
    """Each camera sees the cap of 15° around it, (1 − cos 15°)/2 of the sphere, and the same one no more than once."""
    one = views.train[7]
    at_once = evidence(replace(views, train=(one,) * 15))
    cap = (1 - np.cos(VIEWED_WITHIN_RAD)) / 2
    assert at_once.viewed == pytest.approx(cap, rel=0.05)
    assert 5 * cap < clean.viewed < 15 * cap
    verdict = judge(replace(clean, viewed=at_once.viewed))
    assert (verdict.verdict, verdict.remedy) == ("do not trust", AROUND)
    assert "15 views see the object from 2% of all directions" in verdict.reason
