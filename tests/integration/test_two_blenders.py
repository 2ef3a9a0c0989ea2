"""Two releases of Blender render the same views, but for the noise of their samples.

OTHER_PYTHON names the interpreter of another environment with `panoless[blender]`; Blender is built for one Python.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shinypartial.scene import scene_names

pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[2]
OTHER_PYTHON = os.environ.get("OTHER_PYTHON")
#: Largest measured, over all scenes and passes: 1.3, of the depth of *chrome-block*.
MOST_OF_NOISE = 2.0


def rendered(python: str, scene: str, path: Path) -> dict[str, np.ndarray]:
    command = [python, "-m", "tests.support.small_render", scene, str(path)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=280)
    with np.load(path) as passes:
        return dict(passes)


@pytest.mark.slow
@pytest.mark.skipif(OTHER_PYTHON is None, reason="OTHER_PYTHON names no environment with another Blender.")
@pytest.mark.parametrize("scene", scene_names())
def test_blenders_differ_no_more_than_seeds_of_one(scene: str, tmp_path: Path) -> None:
    """Mean absolute differences of a pass, over the picture."""
    assert OTHER_PYTHON
    ours, theirs = (
        rendered(python, scene, tmp_path / f"{place}.npz")
        for place, python in enumerate((sys.executable, OTHER_PYTHON))
    )
    for name in ours:
        noise = max(np.abs(each[name][0] - each[name][1]).mean() for each in (ours, theirs))
        between = np.abs(ours[name] - theirs[name]).mean()
        assert between <= MOST_OF_NOISE * noise, f"{name}: {between} between Blenders, {noise} between seeds"
