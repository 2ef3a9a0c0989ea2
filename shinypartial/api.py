"""What `import shinypartial` offers: scoring a prediction folder, as the command `shinypartial evaluate` does."""

from pathlib import Path

from shinypartial.evaluation.evaluate import Protocols
from shinypartial.evaluation.evaluate import evaluate as score
from shinypartial.evaluation.scores import Scores


def evaluate(
    prediction: str | Path,
    dataset: str | Path | None = None,
    *,
    protocol: Protocols = "both",
    oracle: str | Path | None = None,
) -> Scores:
    """Score a prediction folder against its dataset; write PREDICTION/scores.json with pictures, return the scores.

    `dataset` is the one that the prediction names when not given. `protocol` scores the benchmark's own protocol
    `linear-v1`, or `both` it and `paper-v1`. `oracle` is the scored folder of the dataset's oracle baseline, else
    DATASET-oracle beside the prediction, where there is one. Raises InputError for files that are missing or broken.
    """
    return score(
        Path(prediction),
        None if dataset is None else Path(dataset),
        protocol=protocol,
        oracle=None if oracle is None else Path(oracle),
    )
