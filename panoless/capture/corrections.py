"""What photographs get wrong, taken back: masks too small or too large in all views, exposures and white balances that
differ, and a focal length or a distortion that is not what it is said to be.

Views are corrected when they are loaded; what a fit found about them is a few numbers.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from panoless.capture.encoding import encoding_of
from panoless.capture.lens import undistorted_view, with_focal_factor
from panoless.capture.masks import MASK_LEVEL
from panoless.capture.silhouettes import mask_distance_px
from panoless.capture.views import TrainView, Views
from panoless.config import FitConfig
from shinypartial.core.conventions import SOLID_ALPHA


@dataclass(frozen=True)
class Corrections:
    """How photographs are corrected before anything else is made of them."""

    mask_offset_px: float = 0.0
    """How far the silhouettes of all masks are moved outward, in pixels of the views."""
    gains: Float[np.ndarray, "V"] | None = None
    """Exposure of each view against the mean; None: they are all alike."""
    focal_factor: float = 1.0
    """The focal length of all views over what is said of it."""
    focal_uncertainty: float | None = None
    """Standard deviation of that factor; None where it was not found."""
    k1: float = 0.0
    """Radial distortion of all views (see `panoless.capture.lens`)."""
    k1_uncertainty: float | None = None
    """Its standard deviation; None where it was not found."""
    balances: Float[np.ndarray, "V 3"] | None = None
    """Gains of each view's channels against its exposure; None: white balance is the same in all views."""
    mask_offsets_px: Float[np.ndarray, "V"] | None = None
    """How far the silhouette of the mask of each view is moved beside that of all; None: masks are alike."""

    @property
    def exposure_stops(self) -> float | None:
        """Standard deviation of log₂ of the gains; None where they are all alike."""
        return None if self.gains is None else float(np.log2(self.gains).std())

    @property
    def white_balance_stops(self) -> float | None:
        """Standard deviation of log₂ of the balances; None where they are all alike."""
        return None if self.balances is None else float(np.log2(self.balances).std())

    @property
    def mask_spread_px(self) -> float | None:
        """Standard deviation of the offsets of masks; None where they are alike."""
        return None if self.mask_offsets_px is None else float(self.mask_offsets_px.std())

    @property
    def channel_gains(self) -> Float[np.ndarray, "V 3"] | None:
        """Of each view and channel; None where they are all alike."""
        if self.gains is None:
            return None
        return self.gains[:, None] * (np.ones((1, 3)) if self.balances is None else self.balances)

    def applied(self, views: Views, config: FitConfig) -> Views:
        """The views as they would be without these errors; themselves where there are none."""
        train = views.train
        if self.focal_factor != 1:
            train = tuple(with_focal_factor(view, self.focal_factor) for view in train)
        if self.k1:
            train = tuple(undistorted_view(view, self.k1) for view in train)
        if self.mask_offset_px or self.mask_offsets_px is not None:
            offsets = self.mask_offset_px + (
                np.zeros(len(train)) if self.mask_offsets_px is None else self.mask_offsets_px
            )
            train = tuple(with_silhouette_moved(view, float(by)) for view, by in zip(train, offsets, strict=True))
        if self.channel_gains is not None:
            gains = torch.from_numpy(self.channel_gains).float()[..., None, None]
            encoding, exposed = encoding_of(config), zip(train, gains, strict=True)
            train = tuple(
                replace(view, radiance=encoding.without_gain(view.radiance, gain.to(view.radiance)))
                for view, gain in exposed
            )
        return views if train is views.train else replace(views, train=train)


NO_CORRECTIONS = Corrections()


def with_silhouette_moved(view: TrainView, offset_px: float) -> TrainView:
    """A view with the contour of its mask moved outward by so many pixels, inward where that is negative.

    With the signed distance d from the contour, positive outside, alpha is clip(½ − d + δ, 0, 1): the share of a pixel
    inside a straight silhouette. What the photograph did not show whole does not become solid. A mask of which nothing
    would be left stays.
    """
    alpha = view.mask.cpu().numpy()
    distance = mask_distance_px(alpha, band_px=abs(offset_px) + 1.5)
    moved = np.clip(0.5 - distance + offset_px, 0, 1)
    moved = np.where(alpha > SOLID_ALPHA, moved, np.minimum(moved, SOLID_ALPHA)).astype(np.float32)
    if not (moved >= MASK_LEVEL).any():
        return view
    mask: Tensor = torch.from_numpy(moved).to(view.mask.device)
    return replace(view, mask=mask, solid=torch.nonzero(mask.flatten() > SOLID_ALPHA)[:, 0])
