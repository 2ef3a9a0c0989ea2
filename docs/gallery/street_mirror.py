"""# A street mirror

A convex mirror on a pole sees nearly everything on its side. It is a height field over its rim. A real one, with a near
ground and the photographer below it, is harder: [what does not work](../results/what-does-not-work.md).
"""

import subprocess
from pathlib import Path

import panoless
import shinypartial

size = ["--resolution", "128", "--train", "24", "--test", "3"]
subprocess.run(["shinypartial", "generate", "--scene", "traffic-mirror", *size, "--output", "street"], check=True)

result = panoless.fit("street", output="street-prediction")
scores = shinypartial.evaluate(result.folder)
print(result.model, scores.normals_environment.median_angular_error_deg, "degrees in the median")

picture = Path("street-prediction/decomposition.jpg")
