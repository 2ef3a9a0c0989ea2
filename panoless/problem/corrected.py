"""What nuisance blocks amount to: corrections of photographs, and poses in the world that the dataset states."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from panoless.capture.corrections import Corrections
from panoless.capture.poses import Poses
from panoless.capture.views import Views
from panoless.config import FitConfig
from panoless.problem.blocks import (
    CameraPoses,
    Distortion,
    Exposures,
    FocalLength,
    MaskOffset,
    MaskOffsets,
    WhiteBalances,
)
from panoless.problem.nuisance import Nuisance


@dataclass(frozen=True)
class Corrected:
    """Corrections and poses, and the factor from the world of the blocks to the one that is stated."""

    corrections: Corrections
    poses: Poses | None
    scale: float

    @classmethod
    def by(cls, nuisance: Nuisance, variances: Mapping[str, Float[np.ndarray, "B M"]] | None = None) -> "Corrected":
        """With the standard deviations of cameras and lens by the variances, where these are known, and model errors.

        Cameras that are eˢ as far away see the same as those where they are stated of a world that is e⁻ˢ as large.
        """
        focal, bent, cameras = (nuisance.get(kind) for kind in (FocalLength, Distortion, CameraPoses))
        exposures, balances = nuisance.get(Exposures), nuisance.get(WhiteBalances)
        offset, offsets = nuisance.get(MaskOffset), nuisance.get(MaskOffsets)
        change = 0.0 if focal is None else float(focal.values[0, 0])
        found = Corrections(
            focal_factor=float(np.exp(change)), mask_offset_px=0.0 if offset is None else -float(offset.values[0, 0])
        )
        sigmas = {
            each.name: np.sqrt(each.with_model_errors(variances[each.name]))
            for each in nuisance.blocks
            if variances is not None and each.name in variances
        }
        if focal is not None and focal.name in sigmas:
            found = replace(found, focal_uncertainty=found.focal_factor * float(sigmas[focal.name][0, 0]))
        if bent is not None:
            found = replace(found, k1=float(bent.values[0, 0]))
            if bent.name in sigmas:
                found = replace(found, k1_uncertainty=float(sigmas[bent.name][0, 0]))
        if offsets is not None:
            found = replace(found, mask_offsets_px=-offsets.values[:, 0])
        if exposures is not None or balances is not None:
            count = len((exposures or balances).values)  # type: ignore[union-attr]
            gains = np.ones(count) if exposures is None else np.exp(exposures.values[:, 0])
            found = replace(
                found,
                gains=gains,
                balances=None if balances is None else np.exp(balances.values @ balances.gain_rows().T),
            )
        scale = float(np.exp(-change))
        poses = None
        if cameras is not None:
            sizes = np.repeat([1.0, scale], 3)
            moved, known = cameras.values * sizes, sigmas.get(cameras.name)
            poses = Poses(moved[:, :3], moved[:, 3:], None if known is None else known * sizes)
        return cls(found, poses, scale)

    def applied(self, views: Views, config: FitConfig) -> Views:
        """Photographs without these errors, from cameras that are where they were."""
        corrected = self.corrections.applied(views, config)
        return corrected if self.poses is None else self.poses.moved(corrected)
