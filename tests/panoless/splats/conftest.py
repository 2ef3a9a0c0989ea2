"""The splatting methods are compared with, and no other room imports theirs: their tests run where the room changes."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder have the mark."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.splats)
