"""The map of a slightly rough mirror: what it shows is sharpened by the lobe that blurred it."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from panoless.capture.encoding import SATURATED
from panoless.environment.fill import fill_unobserved
from panoless.environment.footprints import PixelFootprints
from panoless.environment.lobe import Lobe

SHARPENING_ROUNDS = 20
"""Steps that sharpen the exported map of a rough mirror. Further ones amplify noise."""
STEP_POWER = 1.5
"""Exponent of a step: 1 is the method's, more goes faster."""
SHARPENING_SCALE = 0.16
"""Robust scale of radiance errors, as that of footprints."""
LIT = 0.95
"""Share of the largest value from which a texel of the start is saturated."""
LAMP_BORDER_RAD = 0.0123
"""By so much lamps are smaller at the start than what they saturate: a texel of 128."""
LAMP_LIGHT = 3.0
"""Their radiance at the start, in largest values of views."""
INERTIA = 1e-4
"""Added above and below the bar of a step, in rays times radiance, so that what no pixel sees stays."""
LEAST_LIGHT = 1e-3
"""Radiance at the start of what is darker: zero would stay zero."""


def sharpened_map(
    environment: Float[Tensor, "6 3 L L"],
    areas: Sequence[PixelFootprints],
    lobe: Lobe,
    saturation: Float[Tensor, "3"],
    rounds: int = SHARPENING_ROUNDS,
) -> Float[Tensor, "6 3 L L"]:
    """min_{E ≥ 0} Σ w ‖min(s, A B E) − c‖² from a map of what the mirror shows on, by multiplicative steps
    (Daube-Witherspoon and Muehllehner 1986)

        E ← E · (Bᵀ Aᵀ W c / Bᵀ Aᵀ W A B E)ᵖ .

    They keep it positive, move lamps as fast as what is dim, and the more are taken, the finer is what they sharpen.
    The weights W are Geman and McClure's, found again in each; a saturated pixel, c = s, has none while its prediction
    is saturated, too. What no pixel sees stays.
    """
    resolution, saturation = environment.shape[-1], saturation.to(environment)
    environment = environment.clamp(min=LEAST_LIGHT)
    for _ in range(rounds):
        shown = lobe.blurred(environment)
        wanted, found = torch.zeros_like(environment), torch.zeros_like(environment)
        for each in areas:
            seen = each.seen(shown)
            weight = each.weights(seen, saturation, SHARPENING_SCALE, SATURATED)
            wanted += each.spread(weight * each.radiance, resolution)
            found += each.spread(weight * seen, resolution)
        ratio = (lobe.gathered(wanted) + INERTIA) / (lobe.gathered(found) + INERTIA)
        environment = environment * ratio**STEP_POWER
    return environment


def with_smaller_lamps(
    environment: Float[Tensor, "6 3 L L"], saturation: Float[Tensor, "3"]
) -> Float[Tensor, "6 3 L L"]:
    """A start for a sharpened map: what a lobe saturates about a lamp is filled from around, and the lamp is brighter.

    Of each region in which a channel is saturated, texels within `LAMP_BORDER_RAD` of its border are filled, but for
    the innermost ones of a region that is no wider. Photographs that end at s do not distinguish a lamp from a smaller
    and brighter one; of all that explain them, steps lead to one near to where they start.
    """
    most = saturation.to(environment)[:, None, None]
    lit = environment >= LIT * most
    texels = max(round(LAMP_BORDER_RAD * environment.shape[-1] * 2 / torch.pi), 1)
    depth, inner = lit.float(), lit.float()
    for _ in range(texels):
        inner = -max_pool2d(-inner, 3, 1, 1)
        depth = depth + inner
    deepest = max_pool2d(depth, 2 * texels + 1, 1, texels)
    core = lit & (depth >= deepest)
    around = torch.cat(
        [
            fill_unobserved(torch.where(here, 0.0, light), (~here[:, 0]).float())
            for light, here in zip(environment.split(1, 1), lit.split(1, 1), strict=True)
        ],
        1,
    )
    return torch.where(core, (LAMP_LIGHT * most).expand_as(environment), torch.where(lit, around, environment))
