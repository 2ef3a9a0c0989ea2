"""Benchmark for recovering an environment from partial reflections: scenes, ground truth and scores.

    import shinypartial

    scores = shinypartial.evaluate("predictions/vase-400-default")
    scores.environment, scores.normals

Importing this package loads neither bpy nor torch nor numpy; rooms that need them import them on use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shinypartial.api import evaluate
    from shinypartial.evaluation.scores import Scores

__version__ = "0.2.0"
__all__ = ["Scores", "evaluate"]

_PLACES = {"Scores": "shinypartial.evaluation.scores", "evaluate": "shinypartial.api"}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
