"""What a level set mirrors, in numpy and torch."""

import numpy as np
import torch
from jaxtyping import Float, Int

from panoless.kernels.constants import LEAST_SLANT, SUB_PIXELS
from panoless.kernels.reference.cubemap import project_to_face


def mirrored(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    distance: Float[np.ndarray, "P"],
    pixel_steps: Float[np.ndarray, "P 2 3"],
    samples: int,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P K 3"], Float[np.ndarray, "P"]]:
    """See `panoless.kernels.level_set`."""
    length = np.linalg.norm(derivatives[:, 1:4], axis=1)[:, None]
    normals = derivatives[:, 1:4] / length
    facing = (directions * normals).sum(1)[:, None]
    changes = []
    for step in pixel_steps.transpose(1, 0, 2):
        slide = -distance[:, None] * (step * normals).sum(1)[:, None] / np.minimum(facing, -LEAST_SLANT)
        moved = distance[:, None] * step + slide * directions
        bent = np.einsum("pij,pj->pi", _hessian(derivatives), moved) / length
        bent -= (bent * normals).sum(1)[:, None] * normals
        rate = (step * normals + directions * bent).sum(1)[:, None]
        changes.append(step - 2 * (rate * normals + facing * bent))
    right, down = changes
    middle = directions - 2 * facing * normals
    outgoing = np.stack([middle + u * right + v * down for u, v in SUB_PIXELS[samples]], 1)
    return normals, outgoing, np.maximum(np.linalg.norm(right, axis=1), np.linalg.norm(down, axis=1))


def seen_with_slopes(
    padded: Float[np.ndarray, "6 M M 3"], directions: Float[np.ndarray, "P K 3"]
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "P 3 3"], Int[np.ndarray, "P"]]:
    """See `panoless.kernels.level_set`; slopes by torch's derivatives."""
    resolution, (count, samples, _) = padded.shape[1] - 2, directions.shape
    texels = torch.from_numpy(np.ascontiguousarray(padded, dtype=np.float64)).reshape(-1, 3)
    changed = torch.from_numpy(np.array(directions, dtype=np.float64)).requires_grad_()
    face, st, usable = project_to_face(changed.reshape(-1, 3))
    position = (st + 1) * (resolution / 2) + 0.5
    corner = position.detach().floor().clamp(0, resolution)
    (u, v), (column, row) = (position - corner).unbind(-1), corner.long().unbind(-1)
    stride = resolution + 2
    first = (face * stride + row) * stride + column
    upper = texels[first] * (1 - u)[:, None] + texels[first + 1] * u[:, None]
    lower = texels[first + stride] * (1 - u)[:, None] + texels[first + stride + 1] * u[:, None]
    light = (upper * (1 - v)[:, None] + lower * v[:, None]) * usable[:, None]
    seen = light.reshape(count, samples, 3).mean(1)
    slopes = [torch.autograd.grad(channel.sum(), changed, retain_graph=True)[0].sum(1) for channel in seen.unbind(1)]
    face, st, _ = project_to_face(changed.detach().mean(1))
    column, row = ((st + 1) * (resolution / 2)).floor().long().clamp(0, resolution - 1).unbind(-1)
    index = (face * resolution + row) * resolution + column
    return seen.detach().numpy(), torch.stack(slopes, 1).numpy(), index.numpy()


def mirror_rows(
    derivatives: Float[np.ndarray, "P 10"],
    directions: Float[np.ndarray, "P 3"],
    slopes: Float[np.ndarray, "P 3 3"],
) -> Float[np.ndarray, "P 3 4"]:
    """See `panoless.kernels.level_set`."""
    length = np.linalg.norm(derivatives[:, 1:4], axis=1)[:, None]
    normals = derivatives[:, 1:4] / length
    facing = (directions * normals).sum(1)[:, None]
    along = np.einsum("pci,pi->pc", slopes, normals)[..., None]
    by_gradient = -2 * (along * directions[:, None] + facing[:, None] * slopes)
    by_gradient -= np.einsum("pci,pi->pc", by_gradient, normals)[..., None] * normals[:, None]
    by_gradient /= length[:, None]
    bent = np.einsum("pij,pj->pi", _hessian(derivatives), directions)
    by_value = -np.einsum("pci,pi->pc", by_gradient, bent) / (length * np.minimum(facing, -LEAST_SLANT))
    return np.concatenate([by_value[..., None], by_gradient], 2)


def _hessian(derivatives: Float[np.ndarray, "P 10"]) -> Float[np.ndarray, "P 3 3"]:
    return derivatives[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3)
