"""The fit of a kind with cameras, exposures and masks as unknowns beside its shape."""

from dataclasses import replace

from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import Family, Geometry, Proposal
from panoless.journal import remembered
from panoless.problem.nuisance import (
    Block,
    CameraPoses,
    Distortion,
    Exposures,
    FocalLength,
    MaskOffset,
    MaskOffsets,
    Walls,
    WhiteBalances,
)
from panoless.selection.fitted import Fitted
from panoless.selection.surroundings import brought_near, explains_clearly_more, on_floor, proposed_surroundings


def nuisance_kinds(config: FitConfig) -> tuple[list[type[Block]], list[str]]:
    """Blocks that a configuration leaves open, and the names of those that it wants in any case. Exposures of a high
    dynamic range are as stated.
    """
    corrections = config.corrections
    kinds: list[type[Block]] = []
    if corrections.poses != "off":
        kinds.append(CameraPoses)
    if corrections.lens != "off":
        kinds += [FocalLength, Distortion]
    if corrections.exposure != "off" and not encoding_of(config).high_dynamic_range:
        kinds += [Exposures, WhiteBalances]
    if config.surroundings.mode != "off":
        kinds.append(Walls)
    if corrections.masks != "off":
        kinds += [MaskOffset, MaskOffsets]
    required = [CameraPoses.name] if corrections.poses == "on" else []
    return kinds, [*required, *([FocalLength.name, Distortion.name] if corrections.lens == "on" else [])]


@remembered()
def proposed(source: Family, views: Views, config: FitConfig, *, asked: bool = False) -> Proposal | None:
    """What a kind proposes of views."""
    return source.propose(views, config, asked=asked)


@remembered()
def followed(
    family: Family, views: Views, start: Proposal, fitted: Geometry, around: Surroundings, config: FitConfig
) -> Geometry:
    """A fit that goes on from an earlier one in other surroundings, with cameras where that has them."""
    proposal = replace(start, fitted=fitted.with_poses(None)).in_surroundings(around)
    return family.fit(fitted.corrected(views), proposal, config).with_poses(fitted.poses)


def fit_jointly(family: Family, source: Family, views: Views, start: Proposal, config: FitConfig) -> Fitted:
    """A fit in the surroundings that the proposal asks for, if it explains clearly more than one in a far world; else
    in nearer ones as long as these explain clearly more. `source` makes the proposals of the kind.
    """

    def solved(around: Surroundings) -> Fitted:
        geometry, corrections, decisions = family.solve(
            views,
            start.in_surroundings(around),
            *nuisance_kinds(config),
            config,
            lambda corrected: proposed(source, corrected, config),
        )
        return Fitted(geometry, start, corrections, tuple(decisions))

    around = proposed_surroundings(family, views, start, config)
    found = solved(around)
    corrected = found.corrections.applied(views, config)

    def follow(fitted: Geometry, surroundings: Surroundings) -> Geometry | None:
        return followed(family, corrected, start, fitted, surroundings, config)

    if around.is_far:
        return found.with_geometry(brought_near(corrected, found.geometry, follow, config))
    near = on_floor(corrected, found.geometry, follow, config)
    if config.surroundings.mode == "on":
        return found.with_geometry(near)
    far = follow(near, FAR)
    if far is None or explains_clearly_more(corrected, near, far):
        return found.with_geometry(near)
    return solved(FAR)
