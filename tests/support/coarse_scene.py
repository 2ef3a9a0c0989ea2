"""Scenes of the repository with fewer faces: what is seen of them stays the same and they are made sooner."""

from dataclasses import replace

from shinypartial.scene import Assembly, Part, SceneSpec, Shape, load_scene

MOST = {"segments": 128, "rings": 128, "resolution": 64, "refinements": 0}


def coarse_scene(name: str) -> SceneSpec:
    """The scene with at most so many faces along each direction of its shapes."""
    spec = load_scene(name)
    props = tuple(replace(part, shape=_coarse(part.shape)) for part in spec.props)
    if isinstance(spec.object, Assembly):
        parts = tuple(replace(part, shape=_coarse(part.shape)) for part in spec.object.parts)
        return replace(spec, object=Assembly(parts), props=props)
    return replace(spec, object=_coarse(spec.object), props=props)


def parts_of(spec: SceneSpec) -> tuple[Part, ...]:
    """The parts of the object, one where it is a shape."""
    return spec.object.parts if isinstance(spec.object, Assembly) else (Part(spec.object),)


def _coarse(shape: Shape) -> Shape:
    return replace(shape, **{key: min(getattr(shape, key), most) for key, most in MOST.items() if hasattr(shape, key)})
