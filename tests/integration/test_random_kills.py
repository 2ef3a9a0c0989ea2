"""Commands that the system kills at random moments: the same command ends with the same files, bit for bit, and does
nothing twice that was finished.

All these runs have one thread: with two, a surface of revolution ends with other last digits, which the benchmark
notes. `pytest -m slow tests/integration/test_random_kills.py` kills them as often as the benchmark does, which takes
hours; KILLS=0.1 in the environment, a share of the kills, is a quicker look.
"""

import os
from pathlib import Path

import pytest

from tests.benchmarks.bench_kills import COMMANDS, bear_kills, prepare

SHARE = float(os.environ.get("KILLS", "1"))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_bears_being_killed(name: str, tmp_path: Path) -> None:
    prepare(tmp_path)
    found = bear_kills(name, max(1, round(SHARE * COMMANDS[name].kills)), tmp_path)
    assert found.ends > 0
    assert found.different == found.done_twice == found.left_over == []
