"""Every kind of geometry, the simplest first. A new kind is one line here and one folder beside it."""

from panoless.geometry.base import Family
from panoless.geometry.free_form.kind import FreeFormFamily
from panoless.geometry.height_field.kind import HeightFieldFamily
from panoless.geometry.panes.kind import PanesFamily
from panoless.geometry.plane.kind import PlaneFamily
from panoless.geometry.revolution.kind import RevolutionFamily
from panoless.geometry.sphere.kind import SphereFamily

FAMILIES: dict[str, Family] = {
    family.kind: family
    for family in (
        SphereFamily(),
        PlaneFamily(),
        PanesFamily(),
        HeightFieldFamily(),
        RevolutionFamily(),
        FreeFormFamily(),
    )
}
"""In the order of model selection."""
