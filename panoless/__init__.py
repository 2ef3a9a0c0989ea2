"""Reconstruct the environment that a mirror-like object reflects, from photographs of one side of it.

    import panoless

    result = panoless.fit("datasets/vase-400")
    result.environment, result.visibility, result.model, result.normals(0)

Importing this package loads no torch and no numpy; its functions do when they are first requested. It gives numpy's
OpenBLAS a single thread unless `OPENBLAS_NUM_THREADS` says otherwise: a fit solves very many small systems, over which
two threads wait for each other most of the time.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from shinypartial import __version__ as __version__

if TYPE_CHECKING:
    from panoless.api import Reconstruction, fit, light, load
    from panoless.config import FitConfig
    from panoless.presets import PRESETS

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__all__ = ["PRESETS", "FitConfig", "Reconstruction", "fit", "light", "load"]

_PLACES = {
    "PRESETS": "panoless.presets",
    "FitConfig": "panoless.config",
    "Reconstruction": "panoless.api",
    "fit": "panoless.api",
    "light": "panoless.api",
    "load": "panoless.api",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
