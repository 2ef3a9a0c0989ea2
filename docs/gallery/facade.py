"""# A glass front

The panes of a front tilt by half a degree. One plane is refused, a grid of panes is not. The scene is rendered first,
so there is a truth to compare with. More: [flat and bent mirrors](../explanation/planar-mirrors.md#panes).
"""

import subprocess
from pathlib import Path

import panoless
import shinypartial

size = ["--resolution", "160", "--train", "24", "--test", "3"]
subprocess.run(["shinypartial", "generate", "--scene", "glass-front", *size, "--output", "front"], check=True)

result = panoless.fit("front", model="panes", output="front-prediction")
scores = shinypartial.evaluate(result.folder)
print("normals:", scores.normals_environment.median_angular_error_deg, "degrees in the median")

picture = Path("front-prediction/decomposition.jpg")
