"""Here next to nothing is scored, so that a small map will do, which is resampled and checked sooner."""

import pytest


@pytest.fixture(scope="session")
def sphere_dataset(tmp_path_factory: pytest.TempPathFactory):
    """In place of the one with a map as large as scores require."""
    from tests.support.synthetic_dataset import make_sphere_dataset

    return make_sphere_dataset(tmp_path_factory.mktemp("small-datasets") / "sphere")
