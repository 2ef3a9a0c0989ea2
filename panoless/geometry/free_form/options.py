"""The tuned numbers of a free-form surface's fit."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from shinypartial.io.records import Count, Natural, NonEmpty, NonNegative, Positive, Share


@dataclass(frozen=True)
class FreeFormRound:
    """Gauss–Newton steps on one grid and one map."""

    cells: Count
    """Cells along the longest side of the box, of which the object takes about three quarters."""
    resolution: Count
    """Texels along a face side of the map."""
    robust_scale: Positive
    """Residual (linear radiance) beyond which a pixel loses its vote."""
    samples: Literal[1, 4]
    """Mirrored rays over a pixel, 1 or 4."""
    rays: Count
    """About so many pixels of all views take part."""
    smoothing: NonNegative
    """Weight λ of the integral of |D³φ|² in the normalized frame, against `counted_rays` pixels."""
    steps: Count
    """Most steps."""
    photon_share: Annotated[float, Meta(ge=0, lt=1)] = 0.75
    """Share of a pixel's variance that grows with what it shows, in [0, 1). It takes normals from 0.43° to 0.22° on
    chrome-block over a ground darkened to a tenth, and from 0.11° to 0.09° on sculpture. Where poses are free it
    is 0: on sculpture with cameras turned by 0.5° it would take the mean from 3.8° to 6.4°."""
    anchored: bool = False
    """Whether the surface's change is to be smooth, in place of the surface: details that it has then stay."""
    held: bool = False
    """Whether outlines hold the surface: pixels count as if their σ was the robust scale."""
    outline_gain: Positive = 1.0
    """Factor of the outlines' weight."""
    solver_steps: Count = 30
    """Most conjugate-gradient steps for a Gauss–Newton step. Sixty are no better on sculpture, for twice the time; near
    the end twenty do, which in all rounds would take chair from 1.1° to 1.4° in the mean."""
    under_known_map: bool = False
    """Whether the map stays as the pixels that are trusted tell it, and the surface alone moves."""


@dataclass(frozen=True)
class ConcaveOptions:
    """How hollows are looked for where outlines don't tell the shape.

    "Concave shapes" are an ellipsoid with a hollow off its middle, a bowl with a thick wall and an egg with two
    sockets, traced analytically. Where nothing else is said, a value was chosen on these.
    """

    search: bool = True
    """Whether hollows are looked for at all."""
    rays: Count = 40_000
    """About so many pixels of all views are traced against the surface that is searched."""
    pixels: Count = 2_500
    """Most of them under one hollow that score a candidate."""
    least_pixels: Count = 300
    """Patches that fewer see are left alone. Not tuned."""
    cells: Count = 40
    """Cells along the longest side of the box on which candidates are traced."""
    bounces: Count = 3
    """Reflections that a ray is followed through. Half the pixels of a deep bowl need two or more."""
    scale: Positive = 0.3
    """Color (linear radiance) beyond which disagreement counts no more: wide, so that the score falls early."""
    resolutions: NonEmpty[Count] = (6, 8, 12)
    """Cells along a face side in which directions are compared, from coarse to fine."""
    evaluations: NonEmpty[Count] = (160, 200, 260)
    """Candidates of the descent at each of them."""
    descents: Count = 3
    """Best first guesses that are followed at the first resolution."""
    neighborhood: Positive = 0.12
    """Radius, in the normalized frame, over which the disagreement of pixels is averaged…"""
    least_disagreement: NonNegative = 0.95
    """…and from which they count as unexplained, in what pixels of any direction have: convex parts of a visual hull
    have 0.7, beside a socket 0.83, and a lid 1.0."""
    settled_disagreement: NonNegative = 0.35
    """Mean disagreement of a patch, after the first rounds, from which it may be a lid though no part of it is
    unexplained: under a bright sky, pixels of a shallow dish agree with most others. On the trial shape tray it is 0.43
    under a lid; on flat faces of twist, brick and drum 0.2 to 0.4, on sculpture there is no such patch."""
    least_part: Count = 60
    """Parts of fewer unexplained pixels are left alone. Not tuned."""
    whole_share: Share = 0.6
    """A patch of which at least this share is unexplained is the lid of one hollow; else each part of it may be."""
    lid_angle_deg: Positive = 40.0
    """A patch is what lies within so much of its mean normal."""
    insets: NonEmpty[Positive] = (1.1, 1.0, 0.93, 0.86, 0.79)
    """Sizes of the first guesses, in those of the patch. The lip of tray lies beyond the patch."""
    depths: NonEmpty[Positive] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3)
    """Depths of the first guesses, in mean radii of the patch: right ones are told from wrong ones within a tenth."""
    exponents: NonEmpty[Positive] = (1.3, 1.7, 2.0, 2.5, 4.0)
    """Exponents p of their profiles ρᵖ + δᵖ = 1: from nearly a cone to nearly a box."""
    farthest_guess: Positive = 1.2
    """First guesses that disagree by more than so many times what the patch does are not followed: on tray, the best
    one disagrees as much as the lid does, and what it leads to by half of that."""
    rounding_cells: Positive = 0.7
    """Width over which hollow and surface melt together at the rim."""
    rim_share: Positive = 0.08
    """The lid is fitted to the surface within so much of the rim, in ways to it. Not tuned."""
    lid_stiffness: Positive = 0.02
    """Weight of a lid's squared curvatures, in heights. Not tuned."""
    least_facing: Share = 0.1
    """Cosine between a patch's mean normal and that of a pixel in it. Not tuned."""
    step_middle: Positive = 0.08
    """First standard deviations of a descent, in the patch's radii: of the rim's middle…"""
    step_size: Positive = 0.06
    """…of the logarithm of its size…"""
    step_waves: Positive = 0.05
    """…of the waves of its outline…"""
    step_depth: Positive = 0.08
    """…of its depth, of the reach at its knots and of its lean. Not tuned."""
    least_gain: Share = 0.1
    """A hollow is kept if it lowers the disagreement under it by this share…"""
    standard_errors: NonNegative = 4.0
    """…and by so many standard errors of the views' differences."""
    rounds: NonEmpty[FreeFormRound] = (
        FreeFormRound(28, 16, 0.30, 1, 40_000, 30.0, 5),
        FreeFormRound(28, 32, 0.20, 1, 40_000, 30.0, 5),
        FreeFormRound(36, 32, 0.20, 1, 60_000, 30.0, 3),
        FreeFormRound(36, 64, 0.15, 4, 80_000, 30.0, 4),
    )
    """What is taken from a surface with hollows, instead of the first rounds: these would smooth a socket away."""
    least_held_out_gain: Share = 0.02
    """Share of the held-out error, after these rounds, by which hollows have to lower it."""


@dataclass(frozen=True)
class DescentOptions:
    """How first surfaces descend from far off: by steps under maps so coarse that a normal may be wrong by 20°.

    Chosen on a block with flat faces, a twisted one and a torus, none of them a scene of the benchmark. Their first
    surfaces are wrong by 8.2°, 4.5° and 3.1° in the median. The first rounds alone end at 5.6°, 3.0° and 0.6°; after
    these steps they end at 0.3°, 0.2° and 0.1°.
    """

    rounds: tuple[FreeFormRound, ...] = (
        FreeFormRound(20, 3, 0.5, 1, 8000, 3000.0, 5, anchored=True),
        FreeFormRound(20, 4, 0.5, 1, 8000, 3000.0, 5, anchored=True),
        FreeFormRound(20, 6, 0.4, 1, 8000, 3000.0, 5, anchored=True),
        FreeFormRound(20, 8, 0.4, 1, 8000, 3000.0, 5, anchored=True),
        FreeFormRound(20, 12, 0.3, 1, 8000, 3000.0, 5, anchored=True),
    )
    """None: the first surface with the least disagreement is the start. Half the pixels take normals of the block from
    0.7° to 1.0°; λ of 300 and 10,000 from 0.7° to 0.9° and 1.4°; beginning with 4 texels from 0.8° to 1.8°."""
    followed: Count = 3
    """Of the first surfaces, each held by outlines and not, so many go on after the first round: those with the least
    disagreement. The best one then is not always the best one in the end: after one round and after all and the first
    of the fit, chair held has 0.778 and 0.465, not held 0.753 and 0.571. It is among the first two on chair, pawn,
    crate, bust, drum, die, ingot, eight and horseshoe; on jug and twist others come within 0.014 of it."""
    outline_points: Count = 4000
    """Most outline points of all views."""
    least_disagreement: NonNegative = 0.15
    """Of pixels under the plain surface, after the first round of the fit, from which all first surfaces descend; below
    it the plain one does. It is 0.10, 0.12 and 0.14 on sculpture, chrome-block and ellipsoid, and 0.17 to 0.60 on die,
    horseshoe, twist, drum, jug, crate and bust, where others may start better."""
    judged_pixels: Count = 40_000
    """Of all views, by which what descended is compared…"""
    judged_resolution: Count = 24
    """…with directions in so many cells along a face side: finer than those that choose the ways, as surfaces that end
    well and badly differ by little then."""
    least_gain: Share = 0.02
    """Share of the disagreement, after the first round of the fit, by which what descended has to lower it."""


@dataclass(frozen=True)
class FreeFormOptions:
    """How a level set is fitted to silhouettes and photographs.

    "Development shapes" are sculpture and an ellipsoid, a torus and a wavy ball that are traced analytically. Where
    nothing else is said, a value was chosen on these; "not tuned" is what only has to be large or small enough.
    """

    rounds: NonEmpty[FreeFormRound] = (
        FreeFormRound(20, 16, 0.30, 1, 16_000, 100.0, 5, outline_gain=9.0),
        FreeFormRound(28, 64, 0.80, 4, 24_000, 30.0, 8, outline_gain=9.0),
        FreeFormRound(28, 64, 0.15, 4, 32_000, 30.0, 4, solver_steps=20),
    )
    """From coarse to fine, always taken: the first texels are as wide as a ray turns when its normal does by 2.8°.

    In the second all pixels have their say, so flat faces turn as fast as others. Rounds of 32 texels in its place turn
    them wrongly, and under a narrow scale later ones mend it by 2 % a step: chrome-block at 160 px ends at 0.52° by
    these, at 0.13° by it. Sculpture, horseshoe and dish are the same.

    Outlines count in the first two as if they were right to 0.05 px, not 0.15: chrome-block, drum and twist end at
    0.14°, 0.14° and 0.17° for 0.69°, 0.17° and 0.22°. In the third they would hide that masks are 1 px too small.
    """
    finer: tuple[FreeFormRound, ...] = (
        FreeFormRound(42, 128, 0.10, 4, 40_000, 10.0, 5, solver_steps=20),
        FreeFormRound(60, 128, 0.10, 4, 52_000, 3.0, 4, solver_steps=20),
    )
    """Each taken if held-out views gain by the one before it. The last one that was is taken again with all views."""
    mending: tuple[FreeFormRound, ...] = (
        FreeFormRound(28, 16, 0.80, 4, 40_000, 30.0, 6, under_known_map=True),
        FreeFormRound(28, 16, 0.80, 4, 40_000, 30.0, 6, under_known_map=True),
        FreeFormRound(28, 64, 0.80, 4, 40_000, 30.0, 6),
        FreeFormRound(28, 64, 0.15, 4, 40_000, 30.0, 4),
    )
    """What mends parts of the surface that pixels distrust, as long as held-out views gain by it; none: they stay.
    Chosen on the trial shape jug."""
    most_mendings: Count = 3
    """Taken so often at most. Not tuned."""
    distrusted: Share = 0.2
    """Trust below which a pixel distrusts what it sees. Not tuned."""
    least_distrusted: Share = 0.01
    """Share of such pixels among those that see the surroundings, from which mending is tried: 0.07 and 0.24 on the
    trial shapes jug and bust, 0.0007 on sculpture."""
    least_mending_gain: Share = 0.02
    """Share of the held-out error by which mending has to lower it. Not tuned."""
    detailing: tuple[FreeFormRound, ...] = (
        FreeFormRound(36, 4, 0.80, 1, 20_000, 30.0, 10),
        FreeFormRound(36, 6, 0.80, 1, 20_000, 30.0, 10),
        FreeFormRound(36, 8, 0.80, 1, 20_000, 10.0, 10),
        FreeFormRound(36, 12, 0.80, 1, 20_000, 10.0, 10),
        FreeFormRound(44, 16, 0.50, 1, 40_000, 5.0, 6),
        FreeFormRound(44, 32, 0.40, 4, 60_000, 5.0, 6),
        FreeFormRound(60, 16, 0.50, 1, 60_000, 2.0, 8),
        FreeFormRound(60, 32, 0.40, 4, 80_000, 2.0, 8),
        FreeFormRound(60, 64, 0.30, 4, 80_000, 2.0, 8),
    )
    """What is taken from the first surface in place of the rounds above, where much is left unexplained after them: a
    head with eyes and ears has details that turn by far more than the texels of their maps, and are narrower than their
    cells. Chosen on such a head: 10.7° in the median after the rounds, 9.3° mended, 1.7° after these."""
    detailed_error: NonNegative = 0.11
    """Held-out error from which that is tried. Jug has 0.108, where it does not help, bust 0.13, where it does."""
    least_detailing_gain: Share = 0.02
    """Share of the held-out error by which it has to lower it. Not tuned."""
    concave: ConcaveOptions = ConcaveOptions()
    """How hollows are looked for."""
    least_views: Count = 5
    """With fewer views none is held out, and model selection leaves the kind out. Not tuned."""
    start_cells: Count = 40
    """Cells along the longest side of the first surface, before its first round. Not tuned."""
    start_tensions: NonEmpty[NonNegative] = (0.0, 10.0, 30.0, 100.0)
    """Tensions τ of the plate between contacts (1/length² in the normalized frame) among which the pixels choose. On
    chrome-block over a dark ground the normals of the start are wrong by 9.6°, 6.5°, 3.0° and 4.5° in the median, and
    by 9.1°, 3.8°, 0.5° and 1.1° after the first rounds; sculpture ends within 0.02° from all of them."""
    start_pixels: Count = 8000
    """Of all views, by which they choose…"""
    start_resolution: Count = 12
    """…with directions compared in so many cells along a face side."""
    descent: DescentOptions = DescentOptions()
    """How the start comes near where its steps from there lead to the true surface."""
    margin: Positive = 0.175
    """Between the start and the sides of its box, in its longest side: the support of a spline on the first grid, and
    some room to move. Not tuned."""
    band_cells: Positive = 3.5
    """Coefficients within so many cells of the surface are unknowns: all whose support meets it. Not tuned."""
    counted_rays: Positive = 100_000.0
    """The photographs weigh as much as so many pixels, however many take part."""
    photograph_curvature: Positive = 0.5
    """Factor of the photographs' part of the Gauss–Newton matrix. Along steps on the trial shape twist, their cost has
    0.6 times the curvature that the matrix says where the map stays, and less where it follows. 0.3 is no better.
    It is 1 where cameras or surroundings are unknown, too: there it was not measured."""
    radiance_sigma: Positive = 0.02
    """Standard deviation of a pixel of mean brightness (linear radiance)."""
    outline_sigma_px: Positive = 0.15
    """Standard deviation of an outline's point."""
    outline_scale_px: Positive = 2.0
    """Robust scale of outlines."""
    agreed_outline_gain: Positive = 9.0
    """Factor of the outlines' weight in the last round of all, where photographs agree with the masks. After the rounds
    of `fast` it takes normals of chrome-block from 0.162° to 0.137°, of drum from 0.136° to 0.101°, of twist from
    0.237° to 0.209°, and those of sculpture by 0.003°; 3 gives half of that."""
    agreed_outline_px: Positive = 0.1
    """They agree where the outlines are this near to those of the masks: 0.05 to 0.06 px under right masks, more where
    the shape is wrong…"""
    agreed_pull_px: Positive = 0.01
    """…and pulled no more than this: by up to 0.006 px under right masks and shapes, by 0.05 and 0.09 px on
    chrome-block and sculpture under masks that are 1 px too small."""
    outline_points: Count = 30_000
    """Most outline points of all views. Not tuned."""
    miss_weight: NonNegative = 3.0
    """Weight of a pixel on the object that misses the surface, against an outline's point where those count once. With
    0.3 Sculpture ends at 1.19° under masks that are 1 px too large, and Pawn loses 6 % of its pixels in the rounds of
    `fast`; with 3 at 0.15° and 4 %, with 10 at 3 %. Without missed pixels nothing depends on it."""
    miss_scale_px: Positive = 20.0
    """Its robust scale."""
    gauge: NonNegative = 10.0
    """Weight of (|∇φ| − 1)² at each node within `gauge_cells`."""
    gauge_cells: NonNegative = 2.0
    """From the surface."""
    inner_px: NonNegative = 1.5
    """Pixels nearer to the outline of their mask have no say: they mix two things. Not tuned."""
    least_cosine: Share = 0.12
    """Between the ray and the surface's normal, for a pixel to have a say in the shape."""
    least_map_cosine: Share = 0.03
    """The same for the final map."""
    map_inner_px: NonNegative = 1.0
    """Pixels of the final map lie farther inside their mask. Not tuned."""
    footprints: Count = 2_000_000
    """Pixels whose areas sharpen the final map, for memory."""
    widest_footprint_rad: Positive = 0.15
    """Pixels that mirror more in one direction take no part in that. On sculpture at 200 px 0.05, 0.15 and 0.5 give
    32.8, 33.8 and 33.6 dB."""
    least_footprint_trust: Share = 0.3
    """Nor do pixels that are trusted less; 0.7 costs 0.04 dB there."""
    render_samples: Count = 4
    """Rays along a side of a pixel at an outline, and where mirrored rays turn far or meet the surface again."""
    render_directions: Literal[1, 4] = 4
    """Mirrored rays over the other pixels. Not tuned."""
    widest_render_turn_rad: NonNegative = 0.15
    """Mirrored rays turn far that turn by more over a pixel. On sculpture at 160 px, 0.05 gains 0.1 dB more, for 1.6
    times the time."""
    render_bounces: Count = 8
    """A ray that has not left after so many reflections shows where it goes then. Not tuned."""
    wide_texels: Positive = 4.0
    """A pixel that mirrors so many texels has half a vote."""
    map_smoothness: Positive = 0.05
    """Weight of squared differences of neighboring texels, in rays."""
    map_rounds: Natural = 2
    """Robust rounds of the map after each step."""
    first_map_rounds: Count = 3
    """The same at the start of a round of steps."""
    map_steps: Count = 6
    """Conjugate-gradient steps of each of them."""
    texel_prior: NonNegative = 0.5
    """Rays that ask for nothing in the mean of a texel."""
    trust_cells: Count = 40
    """Cells along the longest side in which trust is measured."""
    trust_scale: Positive = 2.0
    """Robust scale of trust, in medians of the residuals…"""
    least_trust_scale: Positive = 0.02
    """…but at least this (linear radiance)."""
    trust_prior: Positive = 1e-5
    """Share of all rays that each cell of trust has beside its own, of trust `trust_floor`."""
    trust_floor: NonNegative = 0.1
    """Trust where no ray tells, in means."""
    trust_power: NonNegative = 2.0
    """Trust is raised to this power."""
    damping: Positive = 1e-3
    """First μ of Marquardt's damping μ diag(H)."""
    damping_less: Positive = 0.3
    """Factor of μ after a whole step."""
    damping_more: Positive = 4.0
    """Factor of μ for each time that one was shortened."""
    damping_range: tuple[Positive, Positive] = (1e-5, 1.0)
    """Bounds of μ."""
    shortening: Share = 0.35
    """Factor of a step that raises the cost."""
    trials: Count = 4
    """Lengths that are tried."""
    solver_tolerance: NonNegative = 1e-5
    """Conjugate-gradient steps end when the preconditioned residual's energy has fallen to this share."""
    largest_step_cells: Positive = 1.0
    """No coefficient moves by more in one step."""
    least_surroundings_share: Positive = 1e-3
    """Share of the trace of the surroundings' matrix that is added to its diagonal. Not tuned."""
    shared_steps: Count = 8
    """Most steps in which these, or how near the surroundings are, are found on from a fit."""
    least_shared_gain: Share = 3e-4
    """Steps end, where that is unknown, when one lowers the cost by less than this share."""
    pose_steps: Count = 6
    """Most steps of finding poses of views that took no part in a fit."""
    least_held_out_gain: Share = 0.002
    """Share of the held-out error by which a finer round has to lower it."""
    held_out_rays: Count = 200_000
    """Pixels of held-out views, and of the others, that tell it. Not tuned."""
    held_out_resolution: Count = 128
    """Texels along a face side of the map that predicts them."""
    least_gain: Share = 3e-3
    """A round ends when a step lowers the cost by less than this share."""


DEFAULTS = FreeFormOptions()
