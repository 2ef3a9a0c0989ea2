"""Pictures of a decomposed view."""

import numpy as np
import torch
from torch import Tensor

from panoless.export.render import Decomposition
from panoless.kernels.constants import ALPHA_FLOOR
from shinypartial.core.color import to_display


def decomposition_pictures(parts: Decomposition) -> dict[str, np.ndarray]:
    """The decomposition of one test view: render, specular, albedo, normals, depth and alpha."""

    def image(tensor: Tensor) -> np.ndarray:
        return tensor.permute(1, 2, 0).contiguous().numpy()

    covered = parts.alpha > 0.5
    depth = parts.depth[covered]
    near, far = (float(depth.min()), float(depth.max())) if len(depth) else (0.0, 1.0)
    nearness = torch.where(covered, 1 - 0.9 * (parts.depth - near) / max(far - near, 1e-9), torch.zeros(()))
    return {
        "1-render": to_display(image(parts.radiance)),
        "2-specular": to_display(image(parts.specular * parts.alpha)),
        "3-albedo": to_display(image(parts.albedo)),
        "4-normals": np.rint((image(parts.normals_world) + 1) / 2 * 255 * image(covered[None].float())).astype(
            np.uint8
        ),
        "5-depth-near-is-bright": np.rint(nearness.clamp(0, 1).numpy() * 255).astype(np.uint8),
        "6-alpha": np.rint(parts.alpha.clamp(0, 1).numpy() * 255).astype(np.uint8),
    }


def crop_to_object(pictures: dict[str, np.ndarray], alpha: Tensor) -> dict[str, np.ndarray]:
    """The pictures around the object with a twelfth of margin, under their names without numbers."""
    rows, columns = (torch.nonzero(alpha.amax(axis) > ALPHA_FLOOR)[:, 0] for axis in (1, 0))
    if len(rows) == 0:
        rows, columns = (torch.arange(size) for size in alpha.shape)
    margin = max(len(rows), len(columns)) // 12
    window = tuple(slice(max(0, int(x.min()) - margin), int(x.max()) + 1 + margin) for x in (rows, columns))
    return {name.split("-", 1)[1].replace("-", " "): picture[window] for name, picture in pictures.items()}
