"""One view of a scene, rendered small with several seeds: `python -m tests.support.small_render SCENE FILE.npz`."""

import sys
from dataclasses import replace

import numpy as np

from shinypartial.blender.render import open_renderer
from shinypartial.core.trajectory import SWEPT_PATHS, plan_cameras
from shinypartial.scene import override
from tests.support.coarse_scene import coarse_scene

RESOLUTION, SAMPLES, SEEDS = 48, 16, (0, 1)


def main(scene: str, path: str) -> None:
    """Write radiance clipped to [0, 1], alpha, normals, depth and self-reflection, for every seed, to an .npz file."""
    spec = coarse_scene(scene)
    sweeps = 1 if spec.camera.path in SWEPT_PATHS else None
    spec = override(spec, resolution=RESOLUTION, samples=SAMPLES, train=2, test=1, sweeps=sweeps)
    camera = plan_cameras(spec.camera, RESOLUTION).train[0]
    passes: dict[str, list[np.ndarray]] = {}
    for seed in SEEDS:
        with open_renderer(replace(spec, render=replace(spec.render, seed=seed))) as renderer:
            view = renderer.render(camera)
        values = vars(view) | {"radiance": view.radiance.clip(0, 1)}
        for name, value in values.items():
            passes.setdefault(name, []).append(value)
    np.savez(path, **{name: np.stack(each) for name, each in passes.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
