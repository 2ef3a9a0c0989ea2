"""Panes as a kind of geometry."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import ClassVar, cast

import torch

from panoless.capture.corrections import Corrections
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Geometry, Proposal, Propose
from panoless.geometry.height_field.kind import HeightFieldFamily, HeightFieldMirror
from panoless.geometry.height_field.unknowns import HeightFieldUnknowns
from panoless.geometry.panes.fit import fit_panes
from panoless.geometry.panes.joints import one_pane, panes_over, with_bars
from panoless.geometry.panes.model import Panes
from panoless.problem.blocks import Block
from panoless.problem.evidence import Decision


@dataclass(frozen=True)
class PanesMirror(HeightFieldMirror):
    """A mirror in panes: a plane that lines cut, with a smooth height over each cell."""

    kind: ClassVar[str] = "panes"
    height_field: Panes


@dataclass(frozen=True)
class PanesUnknowns(HeightFieldUnknowns):
    """Those of a height field over panes."""

    def refined(self) -> "PanesUnknowns":
        """The same: cameras and masks need no higher degree."""
        return self


class PanesFamily(HeightFieldFamily):
    """Panes of a plane across whose joints slopes jump."""

    kind: ClassVar[str] = "panes"
    geometry: ClassVar[type[Geometry]] = PanesMirror
    label: ClassVar[str] = "panes of it"
    in_few_steps: ClassVar[bool] = False

    def proposed_over(
        self, views: Views, proposal: Proposal, config: FitConfig, *, requested: bool = False
    ) -> Proposal | None:
        """Panes by the slopes of tiles. Of smooth slopes None, or one pane for a user who wants panes."""
        panes = panes_over(self.with_silhouettes(views), proposal.shape)
        if panes is None and requested:
            panes = one_pane(views, proposal.shape)
        return None if panes is None else replace(proposal, shape=panes)

    def as_proposed(self, proposal: Proposal, config: FitConfig) -> Geometry:
        """The panes of the proposal."""
        return PanesMirror(proposal.shape)

    def before_steps(self, views: Views, proposal: Proposal, config: FitConfig) -> Geometry:
        """The panes of the proposal."""
        return self.as_proposed(proposal, config)

    def unknowns(self, views: Views, proposal: Proposal, config: FitConfig) -> PanesUnknowns:
        """Offset, slopes and curvatures of all panes."""
        return PanesUnknowns(proposal.shape)

    def begun(self, views: Views, surface: HeightFieldUnknowns, config: FitConfig) -> HeightFieldUnknowns:
        """The surface itself."""
        return surface

    def solve(
        self,
        views: Views,
        proposal: Proposal,
        kinds: Collection[type[Block]],
        required: Collection[str],
        config: FitConfig,
        propose: Propose,
    ) -> tuple[Geometry, Corrections, list[Decision]]:
        """With the bars between panes that masks show."""
        mirror, corrections, decisions = super().solve(views, proposal, kinds, required, config, propose)
        assert isinstance(mirror, PanesMirror), "panes are fitted"
        panes = with_bars(mirror.corrected(corrections.applied(views, config)), mirror.height_field)
        return replace(mirror, height_field=panes), corrections, decisions

    def finished(self, views: Views, solved: HeightFieldMirror, config: FitConfig) -> HeightFieldMirror:
        """Heights and joints in finer rounds."""
        return cast(HeightFieldMirror, self.refitted(views, solved, config))

    def refitted(self, views: Views, fitted: HeightFieldMirror, config: FitConfig) -> Geometry:
        """Heights and joints by silhouettes and photographs together."""
        panes = cast(Panes, fitted.height_field)
        with torch.no_grad():
            return cast(Geometry, fitted.with_shape(fit_panes(self.with_silhouettes(views), panes)))
