"""Draws docs/images/ball-lobby.jpg: photographs of a ball, the rims that were found, and the light.

panoless light PHOTO PHOTO PHOTO --output my-light
python docs/examples/draw_ball.py my-light docs/images/ball-lobby.jpg
"""

import sys
from pathlib import Path

from PIL import Image

WIDTH = 1020


def draw(light: Path, picture: Path) -> None:
    """Join both pictures of a folder that `panoless light` wrote."""
    rims = Image.open(light / "dataset" / "capture" / "ball.jpg")
    found = Image.open(next(light.glob("*-prediction/environment.jpg"))).resize((WIDTH, WIDTH // 2))
    sheet = Image.new("RGB", (WIDTH, rims.height + found.height))
    sheet.paste(rims, (0, 0))
    sheet.paste(found, (0, rims.height))
    sheet.save(picture, quality=88)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
