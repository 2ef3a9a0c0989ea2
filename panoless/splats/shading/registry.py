"""The methods by the names that `surfels.shading` takes."""

from panoless.splats.shading.base import Shading
from panoless.splats.shading.gaussian_shader import GaussianShader
from panoless.splats.shading.material_refgs import MaterialRefGS
from panoless.splats.shading.ref_gaussian import RefGaussian
from panoless.splats.shading.reflection_strength import ReflectionStrength

LEFT_OUT: dict[str, tuple[str, ...]] = {
    "ref-gaussian": ("a smoothness of normals that it requires on some scenes",),
    "material-refgs": (
        "normals and masks that a network predicts",
        "the perceptual loss",
        "surroundings of Gaussians that are traced",
        "patches of 7 × 7 pixels where two views are compared",
    ),
}
"""What a method publishes and its shading lacks, as predictions state it."""

SHADINGS: dict[str, Shading] = {
    "3dgs-dr": ReflectionStrength(),
    "gaussian-shader": GaussianShader(),
    "ref-gaussian": RefGaussian(),
    "material-refgs": MaterialRefGS(),
}
