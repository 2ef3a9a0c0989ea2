"""Small sets of splats for tests of their blend."""

import torch
from jaxtyping import Float
from torch import Tensor

from panoless.splats.kernels.splats import SplatImages, Splats, blend_splats

SIZE = (18, 21)


def random_splats(count: int, seed: int, channels: int = 5, opacity: float = 0.9) -> dict[str, Float[Tensor, "K _"]]:
    """Round to oblong splats about a picture of `SIZE`, some partly beside it, in float64."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    axes = 1.0 + 3.0 * uniform(count, 2)
    turn = 3.0 * uniform(count)
    first, second = (1 / axes**2).unbind(1)
    cosine, sine = turn.cos(), turn.sin()
    return {
        "centers": uniform(count, 2) * torch.tensor([27.0, 24.0]) - 3,
        "precisions": torch.stack(
            [
                first * cosine**2 + second * sine**2,
                (first - second) * cosine * sine,
                first * sine**2 + second * cosine**2,
            ],
            1,
        ),
        "opacities": (0.05 + (opacity - 0.05) * uniform(count))[:, None],
        "attributes": uniform(count, channels) * 2 - 1,
    }


def blended(splats: dict[str, Float[Tensor, "K _"]], backend: str, depths: Float[Tensor, "K"]) -> SplatImages:
    """Their images by one backend; the order of depths is that of the front."""
    scene = Splats(splats["centers"], splats["precisions"], depths, torch.ones_like(depths, dtype=torch.bool))
    return blend_splats(scene, splats["opacities"][:, 0], splats["attributes"], SIZE, backend=backend)  # type: ignore[arg-type]
