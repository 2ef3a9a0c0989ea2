"""One verdict on a finished fit, with its reason and what helps.

Every doubt is a figure of the evidence over its limit. The risk is the root of the sum of their squares, because
doubts add up: below one the fit is trusted, from `REFUSED` on it is not, and between them it may be wrong
in part. The largest doubt is the reason that is given.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from panoless.capture.views import HELD_OUT_EVERY
from panoless.trust.evidence import Evidence
from shinypartial.prediction.format import Trust, Verdict

LARGEST_VIEW_SHIFT_PX = 0.8
"""Root mean square shift of single silhouettes (px) from which a fit is doubted."""
LARGEST_SILHOUETTE_PX = 1.0
"""Median distance of the silhouettes (px) from which it is."""
LARGEST_SHARE_OF_MATTE = 0.5
"""Unexplained light over that of a matte object from which it is."""
LARGEST_UNEXPLAINED = 0.15
"""Unexplained share of held-out light from which it is; good fits leave 0.01 to 0.05."""
LARGEST_UNEXPLAINED_PART = 0.2
"""Share of the light from places that are not explained from which it is."""
LARGEST_MISSED = 0.03
"""Share of the pixels well inside the masks that the surface leaves bare from which it is."""
LARGEST_SURPLUS = 0.01
"""Pixels that it covers well outside the masks, over those of the masks, from which it is."""
LEAST_VIEWED = 0.08
"""Share of all directions near those of cameras up to which it is."""
LARGEST_SATURATED = 0.3
"""Share of saturated pixels from which it is."""
LARGEST_ROUGHNESS = 0.1
"""Roughness of the object from which it is."""
LEAST_ONE_COLOR = 0.01
"""Light that one color a view leaves unexplained up to which it is."""
REFUSED = 2.0
"""How many times its limit a figure has to be for `do not trust`."""

POSES = "Refine the camera poses and the focal length, or take them from a board or a textured background."
MASKS = "Look at the masks, and at the poses of the views whose silhouettes disagree."
MATTER = "Photograph a shinier object: this one shows its own color."
SHAPE = "Look at poses, masks and exposure first; parts that are concave or see themselves may be wrong as well."
PART = "See where that is: a part may be matte, or a concavity may have been missed. A mesh shows it by its confidence."
SURPLUS = (
    "If --model requested this kind, the object may be of another; else look at the masks, which may lack a part of "
    "it, or the shape has grown one that isn't there."
)
VIEWS = "Add views: at least five that see the object from different sides."
AROUND = "Add views from between these and from farther around, and look at the visibility map."
SHINE = "Photograph a shinier object: what a rough one blurs comes back in part only, beside lamps least of all."
TEXTURE = "Take it to surroundings that differ from one direction to another, or expose longer."
EXPOSURE = "Photograph with a shorter exposure, or in high dynamic range."
NEAR_BALL = (
    "What stands near the ball, and who photographs it, has a low visibility: add views from other sides, or put the "
    "ball on something thin."
)
RIM = "Look at capture/ball.jpg: the circle must lie on the rim of a polished ball; else give --box or --clicks."
LEAST_AGREEMENT = 0.1
"""Correlation from which direct and mirrored views agree for sure: random poses give 0.00 ± 0.01 (37 photographs)."""
#: Light that one color a view leaves unexplained is not distinguished from none below this.
LEAST_SHARE_LEFT = 1e-3


@dataclass(frozen=True)
class _Doubt:
    """A figure that may speak against a fit; `measure` is None where it can't be determined."""

    measure: Callable[[Evidence], float | None]
    limit: float
    reason: Callable[[Evidence], str]
    remedy: str
    of_balls: str | None = None
    """The remedy where a ball was captured, whose shape and cameras are known before; none: no doubt of such fits."""


def _disagreement(found: Evidence) -> float | None:
    """Of a captured ball: the least correlation over that of direct and mirrored views; a single photograph in which
    they can't be compared is trusted in part.
    """
    if found.rim_px is None or (found.agreement is None and found.views > 1):
        return None
    return 2.0 if found.agreement is None else LEAST_AGREEMENT / max(found.agreement, LEAST_SHARE_LEFT)


DOUBTS = (
    _Doubt(
        lambda found: found.view_shift_px,
        LARGEST_VIEW_SHIFT_PX,
        lambda found: (
            f"single views are shifted by {found.view_shift_px:.2g} px ({found.view_shift_deg:.2g}°) "
            "against the common shape, as wrong poses do"
        ),
        POSES,
    ),
    _Doubt(
        lambda found: found.silhouette_px,
        LARGEST_SILHOUETTE_PX,
        lambda found: f"the shape misses the silhouettes by {found.silhouette_px:.2g} px",
        MASKS,
    ),
    _Doubt(
        lambda found: None if found.unexplained is None or not found.matte else found.unexplained / found.matte,
        LARGEST_SHARE_OF_MATTE,
        lambda found: (
            f"a matte object explains held-out views about as well as a mirror "
            f"({found.matte:.2f} and {found.unexplained:.2f} of their light are unexplained)"
        ),
        MATTER,
    ),
    _Doubt(
        lambda found: found.unexplained,
        LARGEST_UNEXPLAINED,
        lambda found: f"{found.unexplained:.0%} of the light in held-out views is unexplained",
        SHAPE,
        NEAR_BALL,
    ),
    _Doubt(
        lambda found: found.unexplained_part,
        LARGEST_UNEXPLAINED_PART,
        lambda found: (
            f"{found.unexplained_part:.0%} of what held-out views show of the object lies where its shape "
            "explains little of it"
        ),
        PART,
    ),
    _Doubt(
        lambda found: found.missed,
        LARGEST_MISSED,
        lambda found: f"the shape leaves {found.missed:.0%} of what lies well inside the masks bare",
        PART,
    ),
    _Doubt(
        lambda found: found.surplus,
        LARGEST_SURPLUS,
        lambda found: f"well outside the masks the shape covers {found.surplus:.1%} as much as they do",
        SURPLUS,
    ),
    _Doubt(
        lambda found: found.roughness,
        LARGEST_ROUGHNESS,
        lambda found: f"the object has a roughness of {found.roughness:.2g}, which blurs what it mirrors",
        SHINE,
    ),
    _Doubt(
        lambda found: found.rim_px,
        LARGEST_SILHOUETTE_PX,
        lambda found: f"the rim of the ball is {found.rim_px:.2g} px off a circular cone",
        RIM,
        RIM,
    ),
    _Doubt(
        _disagreement,
        REFUSED,
        lambda found: (
            "nothing beside the ball says whether it mirrors"
            if found.agreement is None
            else f"what lies beside the ball is not what it mirrors (correlation {found.agreement:.2f})"
        ),
        RIM,
        RIM,
    ),
    _Doubt(
        lambda found: 1 / max(found.viewed, 1e-3),
        1 / LEAST_VIEWED,
        lambda found: f"{found.views} views see the object from {found.viewed:.0%} of all directions only",
        AROUND,
    ),
    _Doubt(
        lambda found: found.saturated,
        LARGEST_SATURATED,
        lambda found: f"{found.saturated:.0%} of the object's pixels are saturated",
        EXPOSURE,
        EXPOSURE,
    ),
    _Doubt(
        lambda found: None if found.one_color is None else 1 / max(found.one_color, LEAST_SHARE_LEFT),
        1 / LEAST_ONE_COLOR,
        lambda found: "the photographs show one plain color, so that they don't distinguish one direction from another",
        TEXTURE,
        TEXTURE,
    ),
)


def judge(found: Evidence) -> Trust:
    """The verdict on that evidence."""
    figures = {name: value for name, value in vars(found).items() if value is not None}
    if found.unexplained is None and found.rim_px is None:
        if found.views <= HELD_OUT_EVERY // 2:
            noun = "view leaves" if found.views == 1 else "views leave"
            reason, remedy = f"{found.views} usable {noun} none to hold out", VIEWS
        else:
            reason, remedy = "no held-out view shows the surface where its mask has the object", MASKS
        return Trust("do not trust", reason, remedy, REFUSED, figures)
    risks = list(_risks(found))
    doubt = max(risks, key=lambda each: each[0])[1]
    risk = math.hypot(*(each for each, _ in risks))
    if risk < 1:
        beside = (
            "" if found.agreement is None else f", and what lies beside it is what it mirrors ({found.agreement:.2f})"
        )
        reason = (
            f"the rim of the ball is a circular cone to {found.rim_px:.2g} px{beside}"
            if found.unexplained is None
            else f"the mirror explains {1 - found.unexplained:.0%} of the light in held-out views, "
            f"and silhouettes agree to {found.silhouette_px:.2g} px"
        )
        return Trust("trust", reason, "", risk, figures)
    word: Verdict = "partly" if risk < REFUSED else "do not trust"
    remedy = doubt.remedy if found.rim_px is None else doubt.of_balls or doubt.remedy
    return Trust(word, doubt.reason(found), remedy, risk, figures)


def _risks(found: Evidence) -> Iterator[tuple[float, _Doubt]]:
    for doubt in DOUBTS:
        measured = doubt.measure(found)
        if measured is not None and (found.rim_px is None or doubt.of_balls):
            yield measured / doubt.limit, doubt
