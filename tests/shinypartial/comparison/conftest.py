"""Here the small dataset is the one whose map need not be resampled to be scored."""

import pytest

from shinypartial.dataset.schema import Dataset


@pytest.fixture(scope="session")
def sphere_dataset(scored_sphere_dataset: Dataset) -> Dataset:
    """In place of the one that other tests read."""
    return scored_sphere_dataset
