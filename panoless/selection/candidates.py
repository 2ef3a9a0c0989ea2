"""Candidates of model selection: the evidence for each as data, and the sentence that is made from it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from panoless.capture.corrections import NO_CORRECTIONS, Corrections
from panoless.geometry.base import from_plain, to_plain

MATTE = "one color a place explains the views, as of a matte object: no mirror was fitted"


class Verdict(StrEnum):
    """What became of a candidate."""

    CHOSEN = "chosen"
    REFUSED_BY_SILHOUETTES = "refused by silhouettes"
    REFUSED_BY_HELD_OUT_VIEWS = "refused by held-out views"
    LEFT_TOO_MUCH = "left too much unexplained"
    """Refused, unless no other kind explains more."""
    NOT_PROPOSED = "not proposed"


@dataclass(frozen=True)
class Candidate:
    """One kind of geometry as a candidate. What was not measured is None."""

    kind: str
    verdict: Verdict
    reason: str
    silhouette_px: float | None = None
    """Median distance of the masks' contours from the candidate's silhouette."""
    overlap: float | None = None
    """Intersection over union of silhouette and masks."""
    held_out_error: float | None = None
    """Mean of ‖e‖²/(‖e‖² + s²) over rays of held-out views, in [0, 1]."""
    camera_turn_deg: float | None = None
    """By how much the cameras were turned, median over views; None where they were fixed."""
    corrections: Corrections = NO_CORRECTIONS
    """Of the photographs that it was fitted to."""
    blocks: tuple[dict[str, Any], ...] = ()
    """Of a joint fit: what was decided of each nuisance block (see `panoless.problem.evidence.Decision`)."""
    principal_point_px: tuple[float, float] | None = None
    """By how much the principal point lies to the right and below of where it is said to be; None where that is not
    determined."""

    @property
    def is_matte(self) -> bool:
        """Whether no mirror was fitted."""
        return self.reason == MATTE


@dataclass(frozen=True)
class Selection:
    """The kind that was chosen, and all candidates in the order in which they were examined, the chosen one last."""

    chosen: str
    candidates: tuple[Candidate, ...]

    @property
    def corrections(self) -> Corrections:
        """Of the photographs, under the kind that was chosen."""
        return self.candidates[-1].corrections if self.candidates else NO_CORRECTIONS

    @property
    def held_out_error(self) -> float:
        """Of the kind that was chosen; one where it was not measured."""
        error = self.candidates[-1].held_out_error if self.candidates else None
        return 1.0 if error is None else error

    @property
    def sentence(self) -> str:
        """The choice in one line."""
        *refused, chosen = self.candidates
        because = "; ".join(f"{each.kind}: {describe(each)}" for each in refused)
        return f"{self.chosen} ({describe(chosen)})" + (f"; before it {because}" if because else "")


def describe(candidate: Candidate) -> str:
    """Verdict and figures of a candidate in words."""
    parts = [candidate.reason]
    if candidate.silhouette_px is not None and candidate.overlap is not None:
        distance = candidate.silhouette_px
        away = f"{distance:.2g} px away" if math.isfinite(distance) else "far away"
        parts.append(f"silhouettes {away}, overlap {candidate.overlap:.0%}")
    if candidate.held_out_error is not None:
        parts.append(f"held-out error {candidate.held_out_error:.4f}")
    if candidate.camera_turn_deg is not None:
        parts.append(f"cameras turned by {candidate.camera_turn_deg:.2g}°")
    if candidate.principal_point_px is not None:
        right, down = candidate.principal_point_px
        parts.append(f"principal point moved by {right:+.1f}, {down:+.1f} px")
    if candidate.corrections.mask_offset_px:
        parts.append(f"masks moved outward by {candidate.corrections.mask_offset_px:.2g} px")
    if candidate.corrections.mask_spread_px is not None:
        parts.append(f"masks differ by {candidate.corrections.mask_spread_px:.2g} px")
    if candidate.corrections.exposure_stops is not None:
        parts.append(f"exposures differ by {candidate.corrections.exposure_stops:.2g} stops")
    if candidate.corrections.white_balance_stops is not None:
        parts.append(f"white balances differ by {candidate.corrections.white_balance_stops:.2g} stops")
    if candidate.corrections.focal_uncertainty is not None:
        change, sigma = 100 * (candidate.corrections.focal_factor - 1), 100 * candidate.corrections.focal_uncertainty
        parts.append(f"focal length changed by {change:+.2f} ± {sigma:.2f} %")
    if candidate.corrections.k1_uncertainty is not None:
        parts.append(f"distortion k1 {candidate.corrections.k1:+.3f} ± {candidate.corrections.k1_uncertainty:.3f}")
    return "; ".join(parts)


def selection_to_plain(selection: Selection) -> dict[str, Any]:
    """The selection as dictionaries, as checkpoints hold it."""
    candidates = [{**to_plain(each), "verdict": str(each.verdict)} for each in selection.candidates]
    return {"chosen": selection.chosen, "candidates": candidates}


def selection_from_plain(chosen: str, candidates: Sequence[dict[str, Any]]) -> Selection:
    """The selection from `selection_to_plain`."""
    listed = (from_plain(Candidate, {**each, "verdict": Verdict(each["verdict"])}) for each in candidates)
    return Selection(chosen, tuple(listed))
