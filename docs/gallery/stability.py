"""# Stability of your method

The suite makes data worse step by step and runs your method on them: here with a focal length that is up to 4 % too
long, and on the anchors that a verdict has to refuse. More:
[test a method where it fails](../how-to/test-where-it-fails.md).
"""

import subprocess
import sys
from pathlib import Path

program = Path(__file__).resolve().parents[1] / "examples" / "write_prediction.py"
method = ["--methods", "--method", f"mine={sys.executable} {program} {{dataset}} {{prediction}}"]
size = ["--resolution", "64", "--train", "12", "--test", "3"]
plan = ["--scenes", "sphere", "--axes", "focal", "--seeds", "0", *size]
subprocess.run(["shinypartial", "stability", *plan, *method, "--output", "suite"], check=True)
print(Path("suite/stability.md").read_text(encoding="utf-8"))

picture = Path("suite/assets/stability-focal.svg")
