"""What photographs get wrong is found by what a geometry explains of them, and only where there is something wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from panoless.alignment.search import PosedProposal
from panoless.capture.corrections import NO_CORRECTIONS, Corrections, with_outline_moved
from panoless.capture.lens import with_focal_factor
from panoless.capture.views import Views
from panoless.geometry.base import Proposal
from panoless.geometry.height_field.kind import HeightFieldMirror
from panoless.geometry.height_field.model import flat_height_field
from panoless.geometry.plane.kind import PlaneFamily, PlaneMirror
from panoless.geometry.registry import FAMILIES
from panoless.presets import PRESETS
from panoless.selection import mask_offset
from panoless.selection.candidates import Candidate, Selection, Verdict, selection_from_plain, selection_to_plain
from panoless.selection.choose import choose_geometry
from panoless.selection.corrections import with_corrections
from panoless.selection.fitted import Fitted, outline_pull_px
from panoless.selection.options import CorrectionOptions
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.dataset.perturb.masks import dilated, eroded
from tests.support.distortion import distorted
from tests.support.mirror_body import body_views, sphere
from tests.support.mirror_height_field import height_field_views
from tests.support.mirror_plane import RECTANGLE, arc, disc, plane_of, reflecting_views
from tests.support.mirror_revolution import around, goblet, revolution_views

CONFIG = replace(PRESETS["fast"], corrections=CorrectionOptions(rays=10_000, resolution=32))
FOCAL = replace(
    CONFIG.corrections,
    rays=20_000,
    lens_rays=10_000,
    lens_resolution=32,
    focal=replace(CONFIG.corrections.focal, least_pull=0.002),
    k1=replace(CONFIG.corrections.k1, least_pull=0.05),
)
"""As few pixels tell it."""
GAINS = np.exp2(np.random.default_rng(4).normal(size=10) * 0.3)
GAINS /= np.exp(np.log(GAINS).mean())
MIRROR = PlaneMirror(plane_of(RECTANGLE))


def unsaturated() -> Views:
    """A flat mirror in half of the light."""
    views = reflecting_views(MIRROR.plane, arc(10, 15.0, size=64))
    return replace(views, train=tuple(replace(view, radiance=view.radiance / 2) for view in views.train))


def exposed(views: Views, gains: np.ndarray) -> Views:
    """By one gain a view, or one a channel."""
    seen = zip(views.train, torch.from_numpy(gains.reshape(len(gains), -1, 1, 1)).float(), strict=True)
    return replace(
        views, train=tuple(replace(view, radiance=(view.radiance * gain).clamp(max=1)) for view, gain in seen)
    )


def as_found(views: Views) -> Fitted:
    proposal = Proposal(MIRROR.plane, 0.0, 1.0)
    return with_corrections(
        FAMILIES["plane"],
        views,
        Fitted(MIRROR, PosedProposal(proposal)),
        CONFIG,
        lambda _, before, anew: Fitted(MIRROR, PosedProposal(proposal)),
    )


def test_exposures_are_corrected_only_where_they_differ() -> None:
    """Then the corrected views are those that were exposed alike."""
    views = unsaturated()
    assert as_found(views).corrections is NO_CORRECTIONS
    corrections = as_found(exposed(views, GAINS)).corrections
    assert corrections.mask_offset_px == 0
    assert corrections.exposure_stops == pytest.approx(np.log2(GAINS).std(), rel=0.05)
    # Few pixels of a view share a texel with other views.
    assert corrections.white_balance_stops is None
    assert corrections.gains == pytest.approx(GAINS, rel=0.04)


def test_white_balances_are_corrected_where_channels_differ() -> None:
    """To half of their spread: what changes along the arc within a texel of a map is taken for gains in part."""
    gains = np.exp2(np.random.default_rng(5).normal(size=(10, 3)) * 0.2)
    gains /= np.exp(np.log(gains).mean(0))
    corrections = as_found(exposed(unsaturated(), gains)).corrections
    assert corrections.balances is not None
    assert corrections.gains is not None
    assert np.log2(corrections.gains[:, None] * corrections.balances / gains).std() < np.log2(gains).std() / 2


def silhouettes_plane(views: Views, before: Fitted | None = None, *, anew: bool = False) -> Fitted:
    """What outlines tell of the mirror at a focal length that is believed: it shrinks as that grows."""
    size = arc(1, size=64)[0].fx / views.train[0].camera.fx
    plane = MIRROR.plane
    scaled = replace(plane, offset=size * plane.offset, boundary=size * plane.boundary)
    return Fitted(PlaneMirror(scaled), PosedProposal(Proposal(scaled, 0.0, 1.0)))


@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_a_wrong_focal_length_is_found_and_a_true_one_believed(factor: float) -> None:
    """To a third of a percent with views of 64 px."""
    views = reflecting_views(MIRROR.plane, arc(20, size=64))
    views = replace(views, train=tuple(with_focal_factor(view, factor) for view in views.train))
    options = replace(FOCAL, exposure="off", masks="off")
    config = replace(CONFIG, corrections=options)
    found = with_corrections(FAMILIES["plane"], views, silhouettes_plane(views), config, silhouettes_plane).corrections
    assert found.focal_factor == pytest.approx(1 / factor, abs=0.003)
    if factor == 1:
        assert found is NO_CORRECTIONS
    else:
        assert found.focal_uncertainty is not None
        assert 0 < found.focal_uncertainty < 0.003


@pytest.mark.parametrize("k1", [0.0, pytest.param(-0.15, marks=pytest.mark.slow), 0.15])
def test_a_distortion_is_found_and_a_pinhole_believed(k1: float) -> None:
    """Of a ball that outlines tell, to a third. A ball shows another focal length nearly as well, which is believed."""
    family = FAMILIES["sphere"]
    views = distorted(body_views(sphere(0.9), 20, 96), k1)

    def ball(views: Views, before: Fitted | None = None, *, anew: bool = False) -> Fitted:
        proposal = family.propose(views, CONFIG, asked=True)
        assert proposal is not None
        return Fitted(family.fit(views, proposal, CONFIG), PosedProposal(proposal))

    options = replace(FOCAL, exposure="off", masks="off", focal=replace(FOCAL.focal, least_pull=1.0))
    config = replace(CONFIG, corrections=options)
    found = with_corrections(family, views, ball(views), config, ball).corrections
    if k1 == 0:
        assert found is NO_CORRECTIONS
    else:
        assert found.k1 == pytest.approx(k1, rel=0.35)
        assert found.k1_uncertainty is not None
        assert 0 < found.k1_uncertainty < 0.05


def with_masks(views: Views, offset_px: float) -> Views:
    """Masks that another program has moved, and black where there is no object."""
    train = []
    for view in views.train:
        alpha = view.mask.double().numpy()
        mask = torch.from_numpy(eroded(alpha, -offset_px) if offset_px < 0 else dilated(alpha, offset_px)).float()
        radiance = view.radiance * (mask / view.mask.clamp(min=1e-3)).clamp(max=1)
        solid = torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0]
        train.append(replace(view, mask=mask, radiance=radiance, solid=solid))
    return replace(views, train=tuple(train))


@pytest.mark.parametrize("offset_px", [-1.5, 0.0, 1.0])
def test_outlines_of_the_true_surface_lie_where_masks_were(offset_px: float) -> None:
    """Outside of masks that were shrunk, inside of those that were grown."""
    views = with_masks(reflecting_views(MIRROR.plane, arc(6, size=64)), offset_px)
    assert outline_pull_px(views, MIRROR) == pytest.approx(-offset_px, abs=0.1)


@pytest.mark.slow
def test_masks_with_a_black_rim_are_shrunk() -> None:
    """A plane is the same for any offset, so only the rim tells; to a pixel, which is what it matters to."""
    views = with_masks(reflecting_views(MIRROR.plane, arc(10, size=64)), 2.0)
    _, corrected = choose_geometry(views, replace(PRESETS["fast"], model="plane"))
    assert corrected.corrections.mask_offset_px == pytest.approx(-2.0, abs=1.0)
    assert "masks moved outward by -" in corrected.sentence


@pytest.mark.slow
@pytest.mark.parametrize("offset_px", [-2.0, 1.5])
def test_a_surface_of_revolution_is_found_under_wrong_masks(offset_px: float) -> None:
    """Whose profile is what outlines tell: its offset comes back to a third of a pixel, of 80 px."""
    views = with_masks(revolution_views(goblet(), around(25, 80)), offset_px)
    _, selection = choose_geometry(views, replace(PRESETS["fast"], model="revolution"))
    assert selection.corrections.mask_offset_px == pytest.approx(-offset_px, abs=0.33)


def test_corrections_survive_a_checkpoint_and_earlier_ones_have_none() -> None:
    candidate = Candidate("plane", Verdict.CHOSEN, "asked for", corrections=Corrections(-1.5, GAINS))
    plain = selection_to_plain(Selection("plane", (candidate,)))
    again = selection_from_plain(**plain).corrections
    assert again.mask_offset_px == -1.5
    assert again.gains == pytest.approx(GAINS)
    del plain["candidates"][0]["corrections"]
    assert selection_from_plain(**plain).corrections == NO_CORRECTIONS
    found = Candidate("plane", Verdict.CHOSEN, "asked for", corrections=Corrections(focal_factor=0.98))
    plain = selection_to_plain(Selection("plane", (found,)))
    assert selection_from_plain(**plain).corrections.focal_factor == 0.98
    for name in ("focal_factor", "focal_uncertainty", "k1", "k1_uncertainty"):
        del plain["candidates"][0]["corrections"][name]
    assert selection_from_plain(**plain).corrections == NO_CORRECTIONS


@pytest.mark.parametrize(("slope", "told"), [(0.0, True), (0.45, False)])
def test_a_proposal_that_explains_nothing_tells_no_offset_of_masks(slope: float, told: bool) -> None:
    """A flat proposal for a convex mirror; of a flat one, masks that are 3 px too large are told."""
    plane = plane_of(disc(24))
    mirror = flat_height_field(plane, 6).domed(slope)
    views = height_field_views(mirror, arc(10, 15.0, size=64))
    large = replace(views, train=tuple(with_outline_moved(view, 3.0) for view in views.train))
    fitted = Fitted(HeightFieldMirror(mirror), PosedProposal(Proposal(plane, 0.0, 1.0)))
    found = mask_offset.find_mask_offset(PlaneFamily(), large, fitted, CONFIG)
    assert found < -1 if told else found == 0
