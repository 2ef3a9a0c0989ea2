"""Here next to nothing is scored, so that a small map will do, which is resampled and checked sooner."""

import pytest

#: Rows of the lat-long map of the small dataset.
MAP_HEIGHT = 32


@pytest.fixture(scope="session")
def sphere_dataset(tmp_path_factory: pytest.TempPathFactory):
    """In place of the one with a map as large as scores ask for."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("small-datasets") / "sphere", environment_height=MAP_HEIGHT)
