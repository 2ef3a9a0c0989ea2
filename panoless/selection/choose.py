"""Which kind of geometry a scene needs: the simplest that explains held-out views as well as surfels do.

A kind that is not needed costs accuracy, too: tilting a flat mirror and turning the environment the other way leaves
every picture as it was, so surfels drift.
"""

from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.geometry.base import Family, Geometry, Proposal, usable_views
from panoless.geometry.registry import FAMILIES
from panoless.selection.candidates import Candidate, Selection, Verdict
from panoless.selection.held_out import Trial, held_out_errors, is_clearly_lower, train_briefly

ANY = "auto"


def choose_geometry(views: Views, config: FitConfig, trial: Trial = train_briefly) -> tuple[Geometry, Selection]:
    """The geometry of the scene and the evidence for it; of surfels it is the start.

    Candidates are examined from the simplest on. One is refused when it misses the silhouettes, or when surfels that
    start on it explain held-out views clearly better. Surfels explain what is left; of the candidates that explained
    the silhouettes they start on the one from which they explained held-out views best. `config.model` overrides.
    Raises InputError when a kind is asked for and can't be proposed.
    """
    if config.model != ANY:
        return _fit_asked(views, config)
    *families, last = FAMILIES.values()
    table, refused, starts = list[Candidate](), dict[str, Proposal](), list[tuple[float, Geometry]]()
    for family in families:
        if family.refines is None:
            proposal = family.propose(views, config, asked=False)
        else:
            proposal = refused.get(family.refines)
        candidate, geometry = _examine(family, proposal, views, config, trial)
        table.append(candidate)
        if geometry is not None and proposal is not None:
            if candidate.verdict == Verdict.CHOSEN:
                return geometry, Selection(family.kind, tuple(table))
            refused[family.kind] = proposal
            starts.append((candidate.surfels_error or 0.0, geometry))
    start = min(reversed(starts), key=lambda each: each[0])[1] if starts else None
    geometry = last.fit(views, Proposal(start, 0.0, 1.0), config)
    table.append(Candidate(last.kind, Verdict.CHOSEN, "no simpler kind explains the views"))
    return geometry, Selection(last.kind, tuple(table))


def _fit_asked(views: Views, config: FitConfig) -> tuple[Geometry, Selection]:
    family = FAMILIES[config.model]
    source = family if family.refines is None else FAMILIES[family.refines]
    proposal = source.propose(views, config, asked=True)
    assert proposal is not None
    geometry = family.fit(views, proposal, config)
    return geometry, Selection(family.kind, (Candidate(family.kind, Verdict.CHOSEN, "asked for"),))


def _examine(
    family: Family, proposal: Proposal | None, views: Views, config: FitConfig, trial: Trial
) -> tuple[Candidate, Geometry | None]:
    """The evidence for one kind, and its geometry where the silhouettes do not refuse it."""
    if proposal is None:
        reason = "silhouettes determine none" if family.refines is None else f"no {family.refines} to start from"
        return Candidate(family.kind, Verdict.NOT_PROPOSED, reason), None
    options, evidence = config.selection, (proposal.silhouette_px, proposal.overlap)
    near = proposal.silhouette_px <= options.largest_silhouette_px
    if not (near and proposal.overlap >= options.least_overlap):
        verdict = Verdict.REFUSED_BY_SILHOUETTES
        return Candidate(family.kind, verdict, "misses the silhouettes", *evidence), None
    geometry = family.fit(views, proposal, config)
    own, free = held_out_errors(usable_views(views, geometry), config, geometry, trial)
    refinable = family.kind in {other.refines for other in FAMILIES.values()}
    unexplained = refinable and float(own.mean()) > options.largest_error
    better = is_clearly_lower(free, own, options)
    verdict = Verdict.REFUSED_BY_HELD_OUT_VIEWS if unexplained or better else Verdict.CHOSEN
    reason = "surfels are clearly better" if better else "surfels are no better"
    if unexplained and not better:
        reason = "leaves too much unexplained"
    return Candidate(family.kind, verdict, reason, *evidence, float(own.mean()), float(free.mean())), geometry
