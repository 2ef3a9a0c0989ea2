"""Compare fills of unobserved directions: hide from known environments what real training views do not observe.

The rays of ground-truth normals of every EVERY-th training view of a dataset say which texels of a cubemap are known.
Each environment, turned about the vertical by 0°, 90°, 180° and 270°, is known there and hidden elsewhere, filled in
six ways, and compared where no ray fell: PSNR of linear light clipped to [0, 1], weighted by solid angle.

Usage: python docs/examples/gap_fill.py OUTPUT.json EVERY DATASET… ENVIRONMENT.exr…
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from panoless.environment import solve as cubemap
from panoless.kernels.cubemap import cubemap_solid_angles, scatter_cubemap
from shinypartial.core.sphere import latlong_to_cube
from shinypartial.dataset.read import open_dataset
from shinypartial.io.files import write_json
from shinypartial.io.images import read_exr_rgb
from shinypartial.oracle.baseline import rays_of_view

RESOLUTION = 64
TEXELS = 6 * RESOLUTION**2
AREA = np.tile(cubemap_solid_angles(RESOLUTION).double().numpy().ravel(), TEXELS // RESOLUTION**2)
FADE_RAD = np.radians(40.0)
Fill = Callable[[np.ndarray], np.ndarray]


def weight_of(dataset: Path, every: int) -> torch.Tensor:
    """Rays per texel."""
    weight = torch.zeros(6, 1, RESOLUTION, RESOLUTION)
    for frame in open_dataset(dataset).train[::every]:
        directions = torch.from_numpy(rays_of_view(frame).directions).float()
        weight += scatter_cubemap(torch.ones(len(directions), 1), directions, RESOLUTION)
    return weight[:, 0]


def laplacian() -> sparse.csr_matrix:
    """Graph Laplacian of the texels of a cube and their four neighbors."""
    around = cubemap._neighbors(RESOLUTION).numpy()
    columns = np.tile(np.arange(TEXELS), 4)
    return (4 * sparse.eye(TEXELS) - sparse.csr_matrix((np.ones(4 * TEXELS), (columns, around.ravel())))).tocsr()


def solver(matrix: sparse.csr_matrix, known: np.ndarray) -> Fill:
    """Values that satisfy matrix · u = 0 where they are hidden."""
    hidden = np.flatnonzero(~known)
    factors = splu(matrix[hidden][:, hidden].tocsc())
    coupling = matrix[hidden][:, np.flatnonzero(known)]

    def fill(values: np.ndarray) -> np.ndarray:
        result = values.copy()
        result[hidden] = factors.solve(-(coupling @ values[known]))
        return result

    return fill


def pyramid(weight: torch.Tensor, relaxed_texels: int) -> Fill:
    """What panoless does; without relaxation it is push–pull."""
    confident = (weight >= 1).float()

    def fill(values: np.ndarray) -> np.ndarray:
        cube = torch.from_numpy(values).float().view(6, RESOLUTION, RESOLUTION, 3).permute(0, 3, 1, 2).contiguous()
        usual, cubemap.RELAXED_TEXELS = cubemap.RELAXED_TEXELS, relaxed_texels
        filled = cubemap.fill_unobserved(cube, confident)
        cubemap.RELAXED_TEXELS = usual
        return filled.permute(0, 2, 3, 1).reshape(-1, 3).double().numpy()

    return fill


def around_the_mean(known: np.ndarray, fill: Fill) -> Fill:
    """A fill of differences from the mean of what is known."""

    def shifted(values: np.ndarray) -> np.ndarray:
        mean = np.average(values[known], axis=0, weights=AREA[known])
        return fill(values - mean) + mean

    return shifted


def fills(weight: torch.Tensor) -> dict[str, Fill]:
    """The six ways."""
    known, graph = (weight >= 1).numpy().ravel(), laplacian()
    faded = solver((graph + sparse.diags(AREA / FADE_RAD**2)).tocsr(), known)
    return {
        "push-pull": pyramid(weight, 0),
        "panoless": pyramid(weight, cubemap.RELAXED_TEXELS),
        "harmonic": solver(graph, known),
        "thin plate": solver((graph @ sparse.diags(AREA.mean() / AREA) @ graph).tocsr(), known),
        "fade to the mean over 40°": around_the_mean(known, faded),
        "mean": around_the_mean(known, lambda values: np.where(known[:, None], values, 0.0)),
    }


def main(output: Path, every: int, inputs: list[Path]) -> None:
    """Compare and write."""
    environments = [np.clip(read_exr_rgb(path), 0, 1) for path in inputs if path.suffix == ".exr"]
    turned = [np.roll(each, each.shape[1] * k // 4, axis=1) for each in environments for k in range(4)]
    truths = [latlong_to_cube(each, RESOLUTION).reshape(-1, 3).astype(float) for each in turned]
    results = {}
    for dataset in (path for path in inputs if path.suffix != ".exr"):
        weight = weight_of(dataset, every)
        gap = (weight == 0).numpy().ravel()
        rows: dict[str, list[float]] = {}
        for name, fill in fills(weight).items():
            errors = [((np.clip(fill(truth), 0, 1) - truth)[gap] ** 2).mean(1) for truth in truths]
            rows[name] = [-10 * float(np.log10(np.average(error, weights=AREA[gap]))) for error in errors]
        base = np.array(rows["push-pull"])
        hidden = float(AREA[gap].sum() / AREA.sum())
        results[dataset.name] = {"hidden share": hidden, "psnr_linear_db": rows}
        print(f"{dataset.name}, every {every}th view: {hidden:.1%} hidden, {len(truths)} environments")
        for name, values in rows.items():
            gain = np.array(values) - base
            error = gain.std(ddof=1) / len(gain) ** 0.5
            print(f"  {name:26s} {np.mean(values):6.2f} dB   {gain.mean():+6.2f} ± {error:.2f} dB against push-pull")
    write_json(
        output, {"every": every, "environments": [path.name for path in inputs if path.suffix == ".exr"], **results}
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), [Path(each) for each in sys.argv[3:]])
