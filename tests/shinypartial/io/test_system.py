"""Memory that is no longer needed goes back to the system."""

import subprocess
import sys

import pytest

FREED_MB = 200
PROGRAM = f"""
import numpy as np
from shinypartial.io.system import release_free_memory

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20

# A piece of 20 MB that was freed moves the border between what glibc keeps and what it returns above 1 MB.
np.ones(20 * 2**17).sum()
pieces = [np.ones(2**17) for _ in range({FREED_MB})]
last = np.ones(2**17)
before = resident_mb()
del pieces
release_free_memory()
print(before - resident_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing is required of the C library")
def test_freed_pieces_below_one_that_is_held_are_given_back() -> None:
    given_back = float(
        subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, check=True, text=True).stdout
    )
    assert given_back > 0.8 * FREED_MB
