"""# Relight an object in Blender

The light of a vase falls on three balls, or on an object of yours. `--to blender` writes a file whose world is that
light. More: [use the light](../how-to/use-the-light.md).
"""

import subprocess
from pathlib import Path

import panoless

panoless.fit("tiny-vase", preset="fast", output="light")
subprocess.run(["shinypartial", "relight", "light", "--output", "relit"], check=True)
subprocess.run(["shinypartial", "convert", "light", "--to", "blender"], check=True)

picture = Path("relit/recovered.png")
