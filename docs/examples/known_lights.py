"""How well lights are recognized: every scene under each of Blender's studio lights, and what `find-light` would say.

Datasets are rendered to FOLDER/SCENE.LIGHT where they are not there yet. A line a scene: details of the right map and
of the best wrong one, lowest and highest over the lights; how far the right one's turn is off; how many are taken.

Usage: python docs/examples/known_lights.py FOLDER
"""

import subprocess
import sys
from pathlib import Path

from shinypartial.blender.runtime import studio_light
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import open_dataset
from shinypartial.io.images import read_exr_rgb
from shinypartial.oracle.known_light import Match, clear_winner, match_worlds, mirrored_rays
from shinypartial.scene import STUDIO_LIGHTS

SCENES = {
    "vase": ["--scene", "vase"],
    "mirror": ["--scene", "mirror"],
    "sculpture": ["--scene", "sculpture"],
    "rough": ["--scene", "vase", "--roughness", "0.3"],
}
SIZE = ["--resolution", "96", "--train", "10", "--test", "2", "--samples", "8"]


def main(folder: Path) -> None:
    """Render, compare and print."""
    worlds = {name: read_exr_rgb(studio_light(name)) for name in STUDIO_LIGHTS}
    for scene, words in SCENES.items():
        right, wrong, turns, taken = [], [], [], 0
        for light in STUDIO_LIGHTS:
            place = folder / f"{scene}.{light}"
            command = ["shinypartial", "generate", *words, "--world", light, *SIZE, "--output", str(place)]
            subprocess.run(command, check=True, capture_output=True)
            matches = match_worlds(mirrored_rays(open_dataset(place)), worlds)
            own = next(each for each in matches if each.name == light)
            right.append(own.correlation)
            wrong.append(max(each.correlation for each in matches if each is not own))
            turns.append(abs(own.turn_deg))
            taken += is_taken(matches)
        spans = (f"{min(each):.2f} to {max(each):.2f}" for each in (right, wrong))
        print(f"| {scene} | {' | '.join(spans)} | {max(turns):.2f} | {taken} of {len(worlds)} |")


def is_taken(matches: tuple[Match, ...]) -> bool:
    """Whether one map is clearly the one."""
    try:
        clear_winner(matches)
    except InputError:
        return False
    return True


if __name__ == "__main__":
    main(Path(sys.argv[1]))
