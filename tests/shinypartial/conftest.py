"""Here the small dataset has its map at the height at which maps are scored, so that scoring resamples none."""

import pytest


@pytest.fixture(scope="session")
def sphere_dataset(tmp_path_factory: pytest.TempPathFactory):
    """In place of the one that other tests read."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("scored-datasets") / "sphere", environment_height=256)
