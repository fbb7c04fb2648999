"""The description of a synthetic scene: parts, materials, lamps, sky, cameras.

All values are plain data (numbers, strings, tuples), in metres with z up, so that a scene is a small JSON file that
Blender's interpreter can read. Colours are linear RGB.
"""

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Literal

Number = float | int
Vector = tuple[Number, Number, Number]
Color = tuple[float, float, float]

Pattern = Literal[
    "plain",
    "planks",
    "wood",
    "tiles",
    "brick",
    "fabric",
    "rug",
    "marble",
    "plaster",
    "speckle",
    "stripes",
    "checker",
    "painting",
    "grass",
    "metal",
    "glass",
]
Shape = Literal[
    "box", "cushion", "cylinder", "sphere", "turned", "extruded", "blob", "torus", "tuft", "foliage", "model"
]


@dataclass(frozen=True)
class Material:
    """A principled BSDF with one procedural pattern of two colours."""

    pattern: Pattern
    color: Color
    second: Color = (0.5, 0.5, 0.5)
    """The pattern's other colour."""
    roughness: Number = 0.5
    metallic: Number = 0.0
    scale: Number = 1.0
    """Frequency of the pattern, relative to the pattern's default."""
    bump: Number = 0.0
    """Strength of the bump map, 0 to 1."""
    coat: Number = 0.0
    """Clear coat, 0 to 1."""
    emission: Number = 0.0
    """Emitted radiance, watts per square metre and steradian."""


@dataclass(frozen=True)
class Part:
    """One mesh: a shape with its size, location and material."""

    shape: Shape
    size: Vector
    """Extent along the local axes, metres; turned and extruded shapes scale their unit profile by it."""
    location: Vector
    """Centre of the shape's bounding box."""
    material: Material
    rotation: Vector = (0.0, 0.0, 0.0)
    """Euler XYZ, radians."""
    profile: tuple[tuple[float, float], ...] = ()
    """turned: (radius, height) in units of the half width and height, bottom to top; extruded: outline in [-.5, .5]."""
    bevel: Number = 0.0
    """Width of rounded edges, metres."""
    seed: int = 0
    """Of shapes with random details."""
    path: str = ""
    """model: a .glb, .gltf, .obj or .blend file."""


@dataclass(frozen=True)
class Lamp:
    """A light source without geometry."""

    kind: Literal["sun", "area", "point", "spot"]
    color: Color
    power: Number
    """sun: W/m^2; else W."""
    location: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (0.0, 0.0, -1.0)
    """Direction in which the light travels; not used by `point`."""
    size: Number = 0.1
    """area: side in metres; point and spot: radius in metres; sun: angular diameter in radians."""
    height: Number = 0.0
    """area: the other side of a rectangle, metres; 0 for a square."""


@dataclass(frozen=True)
class World:
    """The environment light."""

    kind: Literal["color", "sky", "environment"]
    color: Color = (0.0, 0.0, 0.0)
    strength: Number = 1.0
    sun_elevation: Number = 0.8
    """sky: radians above the horizon."""
    sun_azimuth: Number = 0.0
    """sky: azimuth of the sun, radians from +x towards +y."""
    sun_size: Number = 0.0095
    """sky: angular diameter, radians."""
    haze: Number = 1.0
    """sky: amount of dust, 0 to 10."""
    path: str = ""
    """environment: an .hdr or .exr file; a bare name is one that comes with Blender."""
    rotation: Number = 0.0
    """environment: radians about z."""


@dataclass(frozen=True)
class Place:
    """A place for an object on a support surface."""

    location: Vector
    radius: Number
    """Free radius, metres."""
    height: Number
    """Free height, metres."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks from one point at another, with z up in the image."""

    location: Vector
    target: Vector
    field_of_view: Number = 1.05
    """Horizontal, radians."""


@dataclass(frozen=True)
class Scene:
    """A whole scene; the object is put at `places[0]`."""

    name: str
    kind: str
    parts: tuple[Part, ...]
    lamps: tuple[Lamp, ...]
    world: World
    places: tuple[Place, ...]
    bounds: tuple[Vector, Vector]
    """Lowest and highest corner of the cameras' positions."""
    obstacles: tuple[tuple[Vector, Vector], ...] = ()
    """Boxes without cameras inside."""
    notes: dict[str, str] = field(default_factory=dict)
    """Description of the true light, for the benchmark's `scene.json`."""

    def to_json(self) -> str:
        """The scene as JSON, which `blender/` reads without this package."""
        return json.dumps(asdict(self), indent=1)


def rotate_z(point: Vector, angle: Number) -> Vector:
    """Rotate `point` about the z axis, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return (c * point[0] - s * point[1], s * point[0] + c * point[1], point[2])


def add(a: Vector, b: Vector) -> Vector:
    """Sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def direction(azimuth: Number, elevation: Number) -> Vector:
    """Unit vector towards an azimuth (from +x towards +y) and an elevation above the horizon, radians."""
    return (
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    )
