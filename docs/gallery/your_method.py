"""# Your method in the benchmark

A method is any program that writes a [prediction folder](../reference/prediction-format.md). This one takes every
object for a sphere, which is right here. It is scored beside `panoless`. More:
[add a method](../how-to/add-a-method.md).
"""

import subprocess
import sys
from pathlib import Path

import panoless
import shinypartial

size = ["--resolution", "128", "--train", "20", "--test", "3"]
subprocess.run(["shinypartial", "generate", "--scene", "sphere", *size, "--output", "ball"], check=True)

program = Path(__file__).parents[1] / "examples" / "write_prediction.py"
subprocess.run([sys.executable, program, "ball", "predictions/mine"], check=True)
panoless.fit("ball", output="predictions/panoless")

for name in ("mine", "panoless"):
    scores = shinypartial.evaluate(f"predictions/{name}", "ball")
    print(name, f"{scores.environment.as_predicted.observed.psnr_linear:.1f} dB")
subprocess.run(["shinypartial", "report", "predictions/mine"], check=True)

picture = Path("predictions/panoless/decomposition.jpg")
