"""prediction.json reads back as written, also from earlier versions; what is wrong in it is named with its place."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shinypartial.core.errors import InputError
from shinypartial.dataset.schema import Dataset
from shinypartial.prediction.format import (
    DESCRIPTION,
    Candidate,
    ModelSelection,
    Trust,
    read_info,
    read_visibility,
    write_info,
    write_visibility,
)
from tests.support.truth_prediction import write_truth_prediction

SELECTION = ModelSelection(
    "revolution",
    (
        Candidate("plane", 16.2, 0.651, None, "rejected", "16 px away"),
        Candidate("revolution", 0.053, 0.999, 0.0311, "chosen"),
        Candidate("surfels", None, None, 0.1245, "not better"),
    ),
)
VERDICT = Trust("partly", "a reason", "a remedy", 1.2, {"unexplained": 0.3})


@pytest.fixture(scope="module")
def prediction(sphere_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_truth_prediction(tmp_path_factory.mktemp("format") / "truth", sphere_dataset)


def rewrite(prediction: Path, folder: Path, **entries: Any) -> Path:
    """The same prediction.json in another folder, with other entries."""
    content = json.loads((prediction / DESCRIPTION).read_text())
    folder.mkdir(exist_ok=True)
    (folder / DESCRIPTION).write_text(json.dumps({**content, **entries}))
    return folder


def test_every_field_reads_back_as_written(prediction: Path, tmp_path: Path) -> None:
    info = replace(
        read_info(prediction), model_selection=SELECTION, verdict=VERDICT, model="words", primitives=7, model_bytes=9
    )
    write_info(tmp_path, info)
    assert read_info(tmp_path) == info


def test_a_prediction_of_an_earlier_version_has_words_and_no_table(prediction: Path, tmp_path: Path) -> None:
    info = read_info(rewrite(prediction, tmp_path, model="plane (0.1 px)", hardware={"processor": "Desk 9"}))
    assert (info.model, info.model_selection, info.hardware_text) == ("plane (0.1 px)", None, "processor Desk 9")


def test_the_choice_in_words_names_every_candidate() -> None:
    sentence = "revolution was chosen; plane: rejected (16 px away); surfels: not better."
    assert SELECTION.sentence() == sentence
    assert ModelSelection("surfels", ()).sentence() == "surfels was chosen."


def candidate(**entries: Any) -> dict[str, Any]:
    """A selection of one candidate with other entries."""
    usual = {"kind": "plane", "silhouette_px": 0.1, "overlap": 0.9, "held_out_error": None, "verdict": "chosen"}
    return {"model_selection": {"chosen": "plane", "candidates": [{**usual, "reason": "", **entries}]}}


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "overlap above one": (candidate(overlap=1.2), r"candidates\.0\.overlap.*from 0 to 1.*found 1\.2"),
    "negative distance": (candidate(silhouette_px=-1), r"candidates\.0\.silhouette_px.*at least 0"),
    "text for a number": (
        candidate(held_out_error="small"),
        r"candidates\.0\.held_out_error.*a number of at least 0 or none",
    ),
    "unknown key": (candidate(iou=0.9), r"candidates\.0\.iou.*unknown key"),
    "no verdict": (candidate(verdict=" "), r"candidates\.0\.verdict.*not empty"),
    "another one chosen": (candidate(kind="surfels"), r"model_selection\.chosen.*found 'plane'"),
    "seconds as a text": ({"seconds": {"fit": "long"}}, "seconds"),
    "negative seconds": ({"seconds": {"fit": -1.0}}, "seconds"),
    "an unknown field": ({"speed": 3}, "speed"),
}


@pytest.mark.parametrize(
    "visibility", [np.full((8, 16), np.nan), np.full((8, 16), 255.0), np.zeros((8, 8))], ids=["NaN", "8-bit", "square"]
)
def test_visibility_is_a_map_of_shares(tmp_path: Path, visibility: np.ndarray) -> None:
    write_visibility(tmp_path, visibility)
    with pytest.raises(InputError, match=r"visibility in \[0, 1\].*visibility\.exr"):
        read_visibility(tmp_path)


def test_visibility_that_storage_rounds_beyond_one_is_one(tmp_path: Path) -> None:
    write_visibility(tmp_path, np.full((8, 16), 1.0005))
    np.testing.assert_array_equal(read_visibility(tmp_path), 1)


@pytest.mark.parametrize(("entries", "words"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_named_with_its_place(
    prediction: Path, tmp_path: Path, entries: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_info(rewrite(prediction, tmp_path, **entries))
    assert DESCRIPTION in str(caught.value)
    assert "docs/reference/prediction-format.md" in caught.value.remedy
