"""# A vase

A surface of revolution is chosen because nothing simpler explains the silhouettes. The result holds the light, how sure
it is of each direction, and the normals. More: [surfaces of revolution](../explanation/surface-of-revolution.md).
"""

from pathlib import Path

import panoless
import shinypartial

result = panoless.fit("tiny-vase", output="vase")
print(result.model, result.verdict.sentence())
print("seen well:", f"{(result.visibility > 0.5).mean():.0%} of all directions")

scores = shinypartial.evaluate(result.folder)
print("normals:", scores.normals_environment.median_angular_error_deg, "degrees in the median")

picture = Path("vase/decomposition.jpg")
