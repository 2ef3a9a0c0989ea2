"""A kind of geometry in one file: the ellipsoid of the page *Add a kind of geometry*."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pytest
from jaxtyping import Float

from panoless.capture.corrections import with_silhouette_moved
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pixel_rays
from panoless.capture.views import Views
from panoless.config import FitConfig, Model
from panoless.environment.options import SurroundingsOptions
from panoless.geometry.base import Family, Geometry
from panoless.geometry.registry import FAMILIES
from panoless.problem.solve import by_silhouettes_alone
from panoless.selection.candidates import Verdict
from panoless.selection.choose import choose_geometry
from panoless.selection.options import CorrectionOptions
from tests.integration.test_examples import load
from tests.panoless.problem import test_parametric as contract
from tests.support.mirror_body import body_views, ellipsoid

DOCS = Path(__file__).resolve().parents[3] / "docs"
SOURCE = DOCS / "examples" / "ellipsoid.py"
MOST_LINES = 150
AXES = (1.0, 0.8, 0.65)
STATED = CorrectionOptions(poses="off", masks="off", exposure="off", lens="off")
kind = load(SOURCE)


@dataclass(frozen=True)
class Config(FitConfig):
    """With the name of the kind, which a reader adds to `Model`."""

    model: Literal["auto", "ellipsoid"] = "ellipsoid"
    surroundings: SurroundingsOptions = SurroundingsOptions(mode="off")
    corrections: CorrectionOptions = STATED


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The kind and its example for the contract of surfaces of few numbers. The order of kinds is that of selection."""
    monkeypatch.setitem(contract.SURFACES, "ellipsoid", lambda: kind.EllipsoidUnknowns(tilted()))
    kinds = dict(FAMILIES)
    FAMILIES["ellipsoid"] = kind.EllipsoidFamily()
    yield
    FAMILIES.clear()
    FAMILIES.update(kinds)


@pytest.fixture(scope="module")
def views() -> Views:
    """Eight views of a mirror that shares no code with the kind."""
    return body_views(ellipsoid(AXES), 8, 64)


def tilted() -> Any:
    """Three axes askew, beside the origin."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return kind.Ellipsoid(np.array([0.1, -0.05, 0.05]), turn / np.array([0.75, 0.6, 0.5]) ** 2 @ turn.T)


def truth_in(frame: ObjectFrame) -> Any:
    """The mirror of the views in the normalized frame."""
    return kind.Ellipsoid(-frame.center / frame.radius, np.diag(frame.radius**2 / np.square(AXES)))


def normal_errors_deg(found: Geometry, views: Views) -> Float[np.ndarray, "P"]:
    """Angles between normals and those of the mirror, at the solid pixels of all views."""
    truth, errors = truth_in(views.object_frame), []
    for view in views.train:
        rays = pixel_rays(view.camera, view.solid.numpy())
        normals = [surface.hits(*rays).normals for surface in (found.shape, truth)]
        errors.append(np.degrees(2 * np.arcsin(np.linalg.norm(normals[0] - normals[1], axis=1) / 2)))
    return np.concatenate(errors)


def test_the_page_shows_one_short_file() -> None:
    """Its names are those of the contract."""
    assert len(SOURCE.read_text(encoding="utf-8").splitlines()) <= MOST_LINES
    page = (DOCS / "how-to/add-a-kind-of-geometry.md").read_text(encoding="utf-8")
    assert f'--8<-- "{SOURCE.relative_to(DOCS).as_posix()}"' in page
    assert isinstance(FAMILIES["ellipsoid"], Family)
    assert isinstance(kind.EllipsoidMirror(tilted()), Geometry)


def test_the_option_names_all_registered_kinds() -> None:
    del FAMILIES["ellipsoid"]
    assert get_args(Model) == ("auto", *FAMILIES, "surfels")


@pytest.mark.parametrize(
    "promise",
    [
        contract.test_normals_change_at_fixed_rays_as_rows_state,
        contract.test_normals_change_along_the_surface_by_the_shape_operator,
        contract.test_silhouettes_change_as_their_rows_state,
        contract.test_silhouettes_change_with_motions_of_their_rays,
    ],
    ids=lambda promise: promise.__name__,
)
def test_derivatives_are_those_of_finite_differences(promise: Any) -> None:
    promise("ellipsoid")


def test_silhouettes_lead_back_from_other_starts(views: Views) -> None:
    """From flat and shifted ellipsoids to the same, whose numbers are known to 0.002."""
    truth = truth_in(views.object_frame)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        start = kind.EllipsoidUnknowns(kind.Ellipsoid(np.zeros(3), 2 * np.eye(3))).stepped(rng.normal(size=9) / 5)
        found = by_silhouettes_alone(views, start).surface
        np.testing.assert_allclose(found.center, truth.center, atol=2e-3)
        np.testing.assert_allclose(np.linalg.inv(found.matrix), np.linalg.inv(truth.matrix), atol=5e-3)


def test_a_fit_finds_the_normals(views: Views) -> None:
    """Masks of 2 × 2 samples a pixel leave 0.06° in the mean; its state and its mesh are those of the same surface."""
    geometry, selection = choose_geometry(views, Config())
    assert geometry.kind == selection.chosen == "ellipsoid"
    assert normal_errors_deg(geometry, views).mean() < 0.1
    again = type(geometry).from_state_dict(geometry.state_dict())
    assert again.state_dict() == geometry.state_dict()
    mesh = geometry.mesh(views.object_frame)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices / AXES, axis=1), 1, atol=3e-3)
    first, second, third = (mesh.vertices[mesh.faces[:, each]] for each in range(3))
    assert ((np.cross(second - first, third - second) * first).sum(1) > -1e-12).all()


def test_photographs_correct_masks(views: Views) -> None:
    """Silhouettes that are moved by up to a pixel turn normals by 1.5° in the mean, unless the solve frees them."""
    shifts = np.random.default_rng(0).uniform(-1, 1, len(views.train))
    train = (with_silhouette_moved(*each) for each in zip(views.train, (shifts - shifts.mean()).tolist(), strict=True))
    moved = replace(views, train=tuple(train))
    proposal = FAMILIES["ellipsoid"].propose(moved, Config(), requested=True)
    assert normal_errors_deg(kind.EllipsoidMirror(proposal.shape), views).mean() > 1
    geometry, _ = choose_geometry(moved, Config(corrections=replace(STATED, masks="auto")))
    assert normal_errors_deg(geometry, views).mean() < 0.1


def test_model_selection_takes_it_where_no_sphere_does(views: Views) -> None:
    for name in set(FAMILIES) - {"sphere", "ellipsoid"}:
        del FAMILIES[name]
    _, selection = choose_geometry(views, Config(model="auto"))
    assert {each.kind: each.verdict for each in selection.candidates} == {
        "sphere": Verdict.NOT_PROPOSED,
        "ellipsoid": Verdict.CHOSEN,
    }
