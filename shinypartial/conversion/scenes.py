"""Scene files as text: Mitsuba 3, OpenUSD and a web page for three.js, with the light from where it came.

Mitsuba and UsdLux read a lat-long map alike: in the light's own frame its top row is +Y, its middle +Z and a quarter of
its width from the left +X. The conventions here have +Z, +X and +Y there: `LATLONG_TO_WORLD` turns one into the other.
Sources: `envmap.cpp` of Mitsuba 3, which looks up u = atan2(x, −z)/2π; the schema of UsdLux, which quotes OpenEXR:
"latitude 0, longitude 0 points into positive z direction; and latitude 0, longitude pi/2 points into positive x
direction", and longitude falls from π at the left to −π at the right.
"""

import base64
from pathlib import Path

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import front_view
from shinypartial.core.mesh import Mesh
from shinypartial.io.files import atomic_write
from shinypartial.prediction.surface import triangles_of

#: Columns are where the axes x, y, z of a lat-long light of Mitsuba and UsdLux lie in the world.
LATLONG_TO_WORLD = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
#: Of three.js, fetched by the page from a public server.
THREE = "https://cdn.jsdelivr.net/npm/three@0.170.0"


def write_triangles(path: Path, mesh: Mesh) -> None:
    """A binary PLY of triangles in single precision with normals, as Mitsuba reads it."""
    from plyfile import PlyData, PlyElement

    columns = dict(zip(("x", "y", "z", "nx", "ny", "nz"), np.hstack([mesh.vertices, mesh.normals]).T, strict=True))
    table = np.zeros(len(mesh.vertices), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    triangles = triangles_of(mesh)
    lists = np.zeros(len(triangles), [("vertex_indices", "<i4", (3,))])
    lists["vertex_indices"] = triangles
    elements = [PlyElement.describe(table, "vertex"), PlyElement.describe(lists, "face")]
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<").write(str(temporary))


def mitsuba_scene(world: str, surface: str | None, reflectance: tuple[float, float, float], view: "ViewOf") -> str:
    """A scene of Mitsuba 3 with an environment map and, from a PLY, a mirror; files lie beside it."""
    turn = np.eye(4)
    turn[:3, :3] = LATLONG_TO_WORLD
    shape = f"""
    <shape type="ply">
        <string name="filename" value="{surface}"/>
        <bsdf type="twosided">
            <bsdf type="conductor">
                <string name="material" value="none"/>
                <rgb name="specular_reflectance" value="{_numbers(np.array(reflectance))}"/>
            </bsdf>
        </bsdf>
    </shape>"""
    return f"""<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="17"/></integrator>
    <emitter type="envmap">
        <string name="filename" value="{world}"/>
        <transform name="to_world"><matrix value="{_numbers(turn)}"/></transform>
    </emitter>{shape if surface else ""}
    <sensor type="perspective">
        <float name="fov" value="{view.fov_deg:g}"/>
        <transform name="to_world">
            <lookat origin="{_numbers(view.position, ", ")}" target="{_numbers(view.target, ", ")}" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm"><integer name="width" value="512"/><integer name="height" value="512"/></film>
        <sampler type="independent"><integer name="sample_count" value="64"/></sampler>
    </sensor>
</scene>
"""


def usd_scene(world: str, surface: Mesh | None, reflectance: tuple[float, float, float]) -> str:
    """A stage of OpenUSD, +Z up, with a DomeLight and, if there is a surface, a metallic mesh with its normals.

    Matrices of USD act on rows, so they are transposed.
    """
    turn = np.eye(4)
    turn[:3, :3] = LATLONG_TO_WORLD.T
    rows = ", ".join(f"({_numbers(row, ', ')})" for row in turn)
    mesh = "" if surface is None else _usd_mesh(surface, reflectance)
    return f"""#usda 1.0
(
    defaultPrim = "scene"
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "scene"
{{
    def DomeLight "light"
    {{
        asset inputs:texture:file = @{world}@
        token inputs:texture:format = "latlong"
        matrix4d xformOp:transform = ( {rows} )
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}{mesh}
}}
"""


def _usd_mesh(surface: Mesh, reflectance: tuple[float, float, float]) -> str:
    def vectors(values: Float[np.ndarray, "P 3"]) -> str:
        return ", ".join(f"({x:.9g}, {y:.9g}, {z:.9g})" for x, y, z in values)

    triangles = triangles_of(surface)
    return f"""

    def Mesh "mirror" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        uniform token subdivisionScheme = "none"
        point3f[] points = [{vectors(surface.vertices)}]
        normal3f[] normals = [{vectors(surface.normals)}] (
            interpolation = "vertex"
        )
        int[] faceVertexCounts = [{", ".join(["3"] * len(triangles))}]
        int[] faceVertexIndices = [{", ".join(map(str, triangles.ravel()))}]
        uniform bool doubleSided = 1
        rel material:binding = </scene/metal>
    }}

    def Material "metal"
    {{
        token outputs:surface.connect = </scene/metal/shader.outputs:surface>

        def Shader "shader"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = ({_numbers(np.array(reflectance), ", ")})
            float inputs:metallic = 1
            float inputs:roughness = 0
            token outputs:surface
        }}
    }}"""


class ViewOf:
    """A camera that shows a surface whole, from the front and a little above."""

    fov_deg = 35.0

    def __init__(self, surface: Mesh | None) -> None:
        """Of nothing, that of the unit ball."""
        low, high = (-np.ones(3), np.ones(3)) if surface is None else (surface.vertices.min(0), surface.vertices.max(0))
        self.position, self.target = front_view(low, high, self.fov_deg, spare=1.2)


def web_page(light_hdr: bytes, surface_glb: bytes | None) -> str:
    """A page that three.js shows the light and the mirror in. Both are inside; three.js itself comes from the network.

    An equirectangular texture of three.js has +X in its middle and, right of it, +Z, which is −Y of the world: with the
    +Y up axes of the GLB, it is the map as it is.
    """
    glb = "null" if surface_glb is None else f'"{_data(surface_glb, "model/gltf-binary")}"'
    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>Recovered light</title>
<style>body {{ margin: 0; overflow: hidden; }}</style>
<script type="importmap">
{{"imports": {{"three": "{THREE}/build/three.module.js", "three/addons/": "{THREE}/examples/jsm/"}}}}
</script>
<script type="module">
import * as THREE from "three";
import {{ OrbitControls }} from "three/addons/controls/OrbitControls.js";
import {{ RGBELoader }} from "three/addons/loaders/RGBELoader.js";
import {{ GLTFLoader }} from "three/addons/loaders/GLTFLoader.js";
const LIGHT = "{_data(light_hdr, "image/vnd.radiance")}";
const SURFACE = {glb};
const renderer = new THREE.WebGLRenderer({{ antialias: true }});
renderer.toneMapping = THREE.NoToneMapping;
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(35, 1, 0.01, 1000);
const controls = new OrbitControls(camera, renderer.domElement);
const light = await new RGBELoader().loadAsync(LIGHT);
light.mapping = THREE.EquirectangularReflectionMapping;
scene.environment = scene.background = light;
const metal = new THREE.MeshStandardMaterial({{ metalness: 1, roughness: 0 }});
let body = new THREE.Mesh(new THREE.SphereGeometry(1, 64, 32), metal);
if (SURFACE) body = (await new GLTFLoader().loadAsync(SURFACE)).scene;
scene.add(body);
const ball = new THREE.Box3().setFromObject(body).getBoundingSphere(new THREE.Sphere());
controls.target.copy(ball.center);
camera.position.set(0.35, 0.45, 1).setLength(4 * ball.radius).add(ball.center);
function resize() {{
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}}
addEventListener("resize", resize);
resize();
renderer.setAnimationLoop(() => {{ controls.update(); renderer.render(scene, camera); }});
</script>
</html>
"""


def _data(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _numbers(values: np.ndarray, between: str = " ") -> str:
    return between.join(f"{value:.9g}" for value in np.ravel(values))
