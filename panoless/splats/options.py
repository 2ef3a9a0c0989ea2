"""Tuned numbers of surfels: where they start, and how far each is to be trusted."""

from dataclasses import dataclass

from shinypartial.io.records import Count, NonNegative, Positive, Share


@dataclass(frozen=True)
class SurfelOptions:
    """How surfels are placed on a first surface, and what the map that follows them takes. All were chosen on the
    development scenes.
    """

    overlap: Positive = 0.8
    """Radius of surfels over the side of the square that each has to itself."""
    sag_px: Positive = 1.0
    """A surfel's disk may leave the first surface, or the hull, by so much at twice its radius."""
    least_radius_px: Positive = 1.5
    """Strong curvature makes no smaller surfels than these."""
    shrinking_steps: Count = 6
    """Times that a surfel which sticks out of the hull is shrunk at most…"""
    shrinkage: Share = 0.75
    """…and the factor each time."""
    candidates: Count = 8
    """Points drawn for each surfel, to be spread."""
    relaxation_rounds: Count = 3
    """Rounds of Lloyd's relaxation by which surfels spread."""
    initial_rays: Count = 1_000_000
    """Most rays of the map that steps begin with."""
    trial_share: Share = 1 / 8
    """Share of the rays that is enough to tell whom to trust and how fine a map is worth it."""
    trial_resolution: Count = 128
    """Texels along a face side of the map that tells it."""
    trust_views: Count = 40
    """From so many views at most the trust in surfels is told."""
    trust_scale: Positive = 0.15
    """Residual (linear radiance) beyond which a pixel tells against its surfels."""
    prior_pixels: NonNegative = 1.0
    """Pixels' worth of an opinion that every surfel starts with, so that one that is hardly seen is hardly believed…"""
    prior_trust: Share = 0.2
    """…and the trust that this opinion is."""
    trust_power: NonNegative = 4.0
    """The power of the blended trust by which a ray counts."""
