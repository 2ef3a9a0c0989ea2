"""What a user may sweep in `panoless capture`."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from shinypartial.io.records import Count, Finite, Positive, Share


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
    """Blur (Crete et al. 2007, 0 to 1) of the median frame above which a capture is refused: 0.67 after a Gaussian blur
    of 2 pixels, 0.78 after 3."""
    least_change: Share = 0.25
    """By which share of its contrast the border of frames must change where the camera moves."""
    least_corners: Annotated[int, Meta(ge=6)] = 8
    """Corners of the board that a frame must show; a pose needs four, and more make it certain."""
    least_match: Share = 0.8
    """Share of the variance around a corner that the print must explain; what something hides is not explained."""
    most_focal_error: Share = 0.02
    """Standard deviation of the focal length, as a share of it, above which the frames do not determine it."""
    hull_voxels: Count = 96
    """Voxels of the visual hull along a side."""
    ground_texels: Count = 640
    """Texels along a side of the square of ground that is looked at."""
    mask_side_px: Count = 240
    """Masks are found in pictures averaged to no more than this, and only their edges in larger ones: GrabCut takes
    seconds for a picture of 800 pixels."""
    rounds: Count = 3
    """Rounds of votes of views on masks, and of edges."""
    segmenter_side_px: Count = 1024
    """Side of the square picture that a segmentation model is given. This and the two below are those of IS-Net (Qin et
    al. 2022)."""
    segmenter_mean: tuple[Finite, Finite, Finite] = (0.5, 0.5, 0.5)
    """What is subtracted from red, green and blue in [0, 1], first."""
    segmenter_deviation: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """What red, green and blue are divided by then."""
    least_overlap: Share = 0.7
    """Overlap (intersection over union) of a view's mask and the hull's outline, in the median, below which poses and
    masks contradict each other."""
