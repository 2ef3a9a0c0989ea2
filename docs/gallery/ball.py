"""# The light of a lobby, from a chrome ball

Three photographs of a phone are enough. The ball is detected, the photographer removed, and the light exported for any
renderer. More: [a light from a ball](../how-to/ball.md).
"""

from pathlib import Path

import panoless
from shinypartial.dataset.bundled import bundled_photographs

light = panoless.light(bundled_photographs("lobby-ball"), "lobby")
print("\n".join(light.lines))

picture = Path("lobby/lobby-prediction/decomposition.jpg")
