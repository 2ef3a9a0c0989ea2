"""What a user may sweep in `panoless capture`."""

from dataclasses import dataclass

from shinypartial.io.records import Count, Finite, Positive

LEAST_VIEWS = 8
"""A capture of anything but a ball needs so many views with a pose."""


@dataclass(frozen=True)
class CaptureOptions:
    """Sizes of pictures, and what a segmentation model takes."""

    longest_side_px: Count = 1600
    """Larger pictures are averaged over whole blocks of pixels until they are no longer than this, because a fit takes
    time for every pixel."""
    video_frames: Count = 100
    """So many frames of a video: 50 to 100 views are plenty."""
    segmenter_side_px: Count = 1024
    """Side of the square picture that a segmentation model is given. This and the two below are those of IS-Net (Qin et
    al. 2022)."""
    segmenter_mean: tuple[Finite, Finite, Finite] = (0.5, 0.5, 0.5)
    """What is subtracted from red, green and blue in [0, 1], first."""
    segmenter_deviation: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    """What red, green and blue are divided by then."""
