"""Draws docs/images/ball-lobby.jpg: photographs of a ball, the light by them, and three balls in that light.

panoless light lobby-ball
shinypartial relight lights/lobby-ball/lobby-ball-prediction --resolution 1020
python docs/examples/draw_ball.py lights/lobby-ball docs/images/ball-lobby.jpg
"""

import sys
from pathlib import Path

from PIL import Image

WIDTH = 1020
GROUND = (32, 32, 32)
"""Behind the balls (8-bit sRGB)."""
MARGIN = 20


def draw(light: Path, picture: Path) -> None:
    """Join the pictures of a folder that `panoless light` wrote with that of `shinypartial relight`."""
    rims = Image.open(light / "dataset" / "capture" / "ball.jpg")
    found = Image.open(next(light.glob("*-prediction/environment.jpg"))).resize((WIDTH, WIDTH // 2))
    balls = Image.open(next(light.glob("*-prediction-relit/recovered.png"))).convert("RGBA")
    balls = balls.crop(balls.getchannel("A").getbbox())
    sheet = Image.new("RGB", (WIDTH, rims.height + found.height + balls.height + 2 * MARGIN), GROUND)
    sheet.paste(rims, (0, 0))
    sheet.paste(found, (0, rims.height))
    sheet.paste(balls, ((WIDTH - balls.width) // 2, rims.height + found.height + MARGIN), balls)
    sheet.save(picture, quality=88)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
