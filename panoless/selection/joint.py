"""The fit of a kind with cameras, exposures and masks as unknowns beside its shape."""

from panoless.capture.encoding import encoding_of
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.environment.surroundings import FAR, Surroundings
from panoless.geometry.base import Family, Geometry, Proposal
from panoless.journal import remembered
from panoless.problem.blocks import (
    Block,
    CameraPoses,
    Distortion,
    Exposures,
    FocalLength,
    Ground,
    MaskOffset,
    MaskOffsets,
    Walls,
    WhiteBalances,
)
from panoless.selection.fitted import Fitted
from panoless.selection.surroundings import explains_clearly_more, proposed_surroundings


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
        kinds += [Walls, Ground]
    if corrections.masks != "off":
        kinds += [MaskOffset, MaskOffsets]
    required = [CameraPoses.name] if corrections.poses == "on" else []
    required += [FocalLength.name, Distortion.name] if corrections.lens == "on" else []
    return kinds, [*required, Ground.name, *([Walls.name] if config.surroundings.mode == "on" else [])]


@remembered()
def proposed(source: Family, views: Views, config: FitConfig, *, requested: bool = False) -> Proposal | None:
    """What a kind proposes of views."""
    return source.propose(views, config, requested=requested)


@remembered()
def refitted(family: Family, views: Views, fitted: Geometry, around: Surroundings, config: FitConfig) -> Geometry:
    """A geometry after few more steps in other surroundings, with cameras where it has them."""
    start = fitted.with_poses(None).in_surroundings(around)
    return family.refitted(fitted.corrected(views), start, config).with_poses(fitted.poses)


def fit_jointly(family: Family, source: Family, views: Views, start: Proposal, config: FitConfig) -> Fitted:
    """A fit whose walls start where the proposal has them, above the ground that is stated, or above the floor that it
    shows, if held-out views are clearly better explained than without one. `source` makes the proposals of the kind.
    """

    def again(corrected: Views) -> Proposal | None:
        found = proposed(source, corrected, config)
        return None if found is None else family.proposed_over(corrected, found, config)

    def solved(around: Surroundings) -> Fitted:
        geometry, corrections, decisions = family.solve(
            views,
            start.in_surroundings(around),
            *nuisance_kinds(config),
            config,
            again,
        )
        return Fitted(geometry, start, corrections, tuple(decisions))

    around = proposed_surroundings(family, views, start, config)
    found = solved(around)
    if around.floor is None or views.ground is not None or config.surroundings.mode == "on":
        return found
    corrected = found.corrections.applied(views, config)
    far = refitted(family, corrected, found.geometry, FAR, config)
    return found if explains_clearly_more(corrected, found.geometry, far) else solved(FAR)
