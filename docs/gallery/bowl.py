"""# A dish

Silhouettes do not show the inside of a dish. A concavity is searched by how well pixels agree on what they mirror.
More: [free forms](../explanation/free-form.md#concavities).
"""

import subprocess
from pathlib import Path

import panoless
import shinypartial

size = ["--resolution", "128", "--train", "30", "--test", "3"]
subprocess.run(["shinypartial", "generate", "--scene", "dish", *size, "--output", "dish"], check=True)

result = panoless.fit("dish", output="dish-prediction")
scores = shinypartial.evaluate(result.folder)
print(result.verdict.sentence())
print("normals:", scores.normals_environment.median_angular_error_deg, "degrees in the median")

picture = Path("dish-prediction/decomposition.jpg")
