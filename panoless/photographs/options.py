"""Tuned numbers of `panoless capture`."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from shinypartial.io.records import Count, Finite, NonNegative, Positive, Share


@dataclass(frozen=True)
class CaptureOptions:
    """What photographs must be like, and how masks are found."""

    longest_side_px: Count = 1600
    """Larger pictures are averaged over whole blocks of pixels until they are no longer than this, because a fit takes
    time for every pixel."""
    video_frames: Count = 100
    """So many frames of a video: 50 to 100 views are plenty."""
    least_views: Annotated[int, Meta(ge=3)] = 8
    """A capture needs so many views with a pose."""
    least_posed: Share = 0.5
    """Share of the frames that must get a pose: with fewer, those that do are likely to be wrong."""
    most_blur: Share = 0.75
    """Blur (Crete et al. 2007, 0 to 1) of the median frame above which a capture is refused. *Vase*, *mirror* and
    *sculpture* before their surroundings have 0.42, 0.67 after a Gaussian blur of 2 pixels, and 0.78 after 3."""
    least_contrast: Positive = 0.1
    """Standard deviation of light at the border of the median frame, as a share of its mean, from which it can be told
    whether the camera moved. A studio's plain background has less."""
    least_change: Share = 0.25
    """By which share of that contrast the border must change. It changes by 1.6 in a film of *sculpture* in a room, 0.6
    where all borders show a patterned ground; before a camera that stands still by its noise."""
    board_frames: Count = 8
    """Frames in which a board is looked for that nobody named: half of them must show it. Not tuned."""
    least_corners: Annotated[int, Meta(ge=6)] = 8
    """Corners of the board that a frame must show; a pose needs four, and more make it certain."""
    corner_blurs_px: tuple[NonNegative, ...] = (1.5, 0.7, 0.7)
    """Rounds in which corners are found anew by the print around them, each with a blur of both. On a
    film of *sculpture*, 480 pixels wide, cameras are then off by 0.01° in the median, in place of 0.25°."""
    corner_window: Positive = 0.7
    """Half side of the window around a corner, in squares of the board."""
    corner_reach: Share = 0.15
    """How far a corner may be from where the present pose has it, in squares: a marker's cell is 0.11."""
    least_match: Share = 0.8
    """Share of the window's variance that the print must explain; what something hides is not explained."""
    most_focal_error: Share = 0.02
    """Standard deviation of the focal length, as a share of it, above which the frames do not determine it."""
    exhaustive_frames: Count = 60
    """Up to so many frames, each is matched with each; else with its neighbors in time."""
    neighbors: Count = 12
    """So many neighbors, where frames are matched with these."""
    hull_voxels: Count = 96
    """Voxels of the visual hull along a side."""
    hull_spare: Positive = 1.3
    """Half side of the hull's cube over the radius that rectangles or masks suggest."""
    tolerated: Share = 0.1
    """Share of the masks that may be left out of the hull, where the others contradict them."""
    least_filled: Share = 0.95
    """Share of the masks, in the median view, that the outline of their hull must fill. Those of *vase* have 0.99."""
    ground_thickness: Positive = 0.005
    """Points so near to a plane lie on it, as a share of the distance of the cameras."""
    ground_points: Share = 0.3
    """Share of the points of structure from motion that make a plane the ground. Not tuned."""
    ground_side_px: Count = 640
    """Masks by the ground are found in pictures averaged to no more than this. The numbers below were chosen on the
    films *sculpture-board*, *chrome-ball-board* and *pot-ground*."""
    ground_reach: Share = 0.5
    """Half side of the square of ground that is looked at, as a share of the distance of the cameras."""
    ground_texels: Count = 640
    """Texels along a side of it."""
    ground_candidates: Count = 8
    """Views of which each texel takes the one with which most others agree."""
    ground_difference: Share = 0.1
    """Codes of one place of the ground differ by less, of 1, between views that agree."""
    ground_agreeing: Count = 4
    """So many views must agree on a texel of the ground."""
    ground_share: Share = 0.15
    """So must this share of the views that reach it; what the object hides in most views is known from the others."""
    ground_window_px: Count = 7
    """Side of a window that shows the ground, or does not."""
    ground_wide_px: Count = 17
    """Side of a window near it that has to show it, too, because a small one can look like it by chance."""
    ground_noise: Positive = 0.06
    """Contrast, in codes of 1, that a plain window counts as having."""
    ground_match: Share = 0.1
    """A window shows the ground where less than this share of the contrast is left."""
    ground_cleared: tuple[Share, Share, Share] = (0.12, 0.15, 0.3)
    """A point of space is the object for sure, likely, or perhaps, where ground is seen at it in a smaller share of the
    views. At points within the object that share is 0.02 to 0.10."""
    band: Share = 0.03
    """Half width of the band about an outline in which the edge is looked for, as a share of √area."""
    band_of_turn: Share = 0.1
    """So much more of √area, times the sine of the angle from the neighbor, where an outline is that of a neighboring
    view."""
    voters: Count = 5
    """So many views, itself and its neighbors, decide on a mask before its edge is found anew."""
    mask_side_px: Count = 240
    """Masks are found in pictures averaged to no more than this, and only their edges in larger ones: GrabCut takes
    seconds for a picture of 800 pixels."""
    rounds: Count = 3
    """Rounds of votes and edges."""
    click_px: Count = 2
    """Radius of what a click marks, in pixels of those pictures. Not tuned."""
    segmenter_side_px: Count = 1024
    """Side of the square picture that a segmentation model is given. This and the two below are those of IS-Net (Qin et
    al. 2022)."""
    segmenter_mean: tuple[Finite, Finite, Finite] = (0.5, 0.5, 0.5)
    """What is subtracted from red, green and blue in [0, 1], first."""
    segmenter_deviation: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """What red, green and blue are divided by then."""
    least_overlap: Share = 0.7
    """Overlap (intersection over union) of a view's mask and the hull's outline, in the median, below which poses and
    masks contradict each other: 0.99 with true masks of *vase*, 0.9 where those found of *mirror* are right to 0.98,
    0.65 where those of *vase* are right to 0.9, and 0.1 where they are wrong (*sculpture*)."""
