"""Description of a synthetic scene (parts, materials, lamps, sky), and cameras in it.

All values are numbers, strings and tuples, in metres with z up, because Blender's interpreter reads a scene as JSON.
Colours are linear RGB.
"""

import math
import random
from dataclasses import dataclass, field
from typing import Literal

Number = float | int
Vector = tuple[Number, Number, Number]
Color = tuple[float, float, float]

Pattern = Literal[
    "plain", "planks", "wood", "tiles", "brick", "fabric", "rug", "marble", "plaster", "speckle", "stripes", "checker",
    "painting", "grass", "metal",
]  # fmt: skip
Shape = Literal["box", "cushion", "cylinder", "sphere", "turned", "extruded", "blob", "torus", "tuft", "foliage"]


@dataclass(frozen=True)
class Material:
    """A principled BSDF with one procedural pattern of two colours."""

    pattern: Pattern
    color: Color
    second: Color = (0.5, 0.5, 0.5)
    """Second colour of the pattern."""
    roughness: Number = 0.5
    metallic: Number = 0.0
    scale: Number = 1.0
    """Frequency of the pattern, relative to its default."""
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
    """Extent along the local axes, metres, also the scale of the unit profile of turned and extruded shapes."""
    location: Vector
    """Centre of the shape's bounding box."""
    material: Material
    rotation: Vector = (0.0, 0.0, 0.0)
    """Euler XYZ, radians."""
    profile: tuple[tuple[float, float], ...] = ()
    """Profile. turned: (radius, height) in half widths and heights, bottom to top; extruded: outline in [-.5, .5]."""
    bevel: Number = 0.0
    """Width of rounded edges, metres."""
    seed: int = 0
    """Seed of shapes with random details."""


@dataclass(frozen=True)
class Lamp:
    """A light source without geometry."""

    kind: Literal["sun", "area", "point", "spot"]
    color: Color
    power: Number
    """Power, W; of a sun W/m^2."""
    location: Vector = (0.0, 0.0, 0.0)
    direction: Vector = (0.0, 0.0, -1.0)
    """Direction in which the light travels; not used by `point`."""
    size: Number = 0.1
    """Side of an area, radius of a point or spot, metres; angular diameter of a sun, radians."""
    height: Number = 0.0
    """Other side of a rectangular area, metres; 0 for a square."""


@dataclass(frozen=True)
class World:
    """The environment light."""

    kind: Literal["color", "sky", "environment"]
    color: Color = (0.0, 0.0, 0.0)
    strength: Number = 1.0
    sun_elevation: Number = 0.8
    """Elevation of a sky's sun, radians above the horizon."""
    sun_azimuth: Number = 0.0
    """Azimuth of a sky's sun, radians from +x towards +y."""
    sun_size: Number = 0.0095
    """Angular diameter of a sky's sun, radians."""
    haze: Number = 1.0
    """Amount of dust in a sky, 0 to 10."""
    path: str = ""
    """Environment map, .hdr or .exr; a bare name is a map that comes with Blender."""
    rotation: Number = 0.0
    """Rotation of the environment map about z, radians."""


@dataclass(frozen=True)
class Place:
    """Place for an object on a support surface."""

    location: Vector
    radius: Number
    """Free radius, metres."""
    height: Number
    """Free height, metres."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera at one point, looking at another, with z up in the image."""

    location: Vector
    target: Vector
    field_of_view: Number = 1.05
    """Horizontal field of view, radians."""


@dataclass(frozen=True)
class Scene:
    """A whole scene; objects are placed at `places[0]`."""

    name: str
    kind: str
    parts: tuple[Part, ...]
    lamps: tuple[Lamp, ...]
    world: World
    places: tuple[Place, ...]
    bounds: tuple[Vector, Vector]
    """Lowest and highest corner of the cameras' positions."""
    obstacles: tuple[tuple[Vector, Vector], ...] = ()
    """Boxes that cameras avoid."""
    notes: dict[str, str] = field(default_factory=dict)
    """Description of the true light, for the benchmark's `scene.json`."""


def rotate_z(point: Vector, angle: Number) -> Vector:
    """Rotate `point` about the z axis, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return (c * point[0] - s * point[1], s * point[0] + c * point[1], point[2])


def add(a: Vector, b: Vector) -> Vector:
    """Add two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def direction(azimuth: Number, elevation: Number) -> Vector:
    """Compute the unit vector towards an azimuth (from +x towards +y) and an elevation, radians."""
    flat = math.cos(elevation)
    return (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))


ARC_LENGTH = 5
"""Number of views per camera arc (paper, Sec. 5.2)."""


def _is_free(scene: Scene, eye: Vector) -> bool:
    low, high = scene.bounds
    if any(not low[i] <= eye[i] <= high[i] for i in range(3)):
        return False
    margin = 0.12  # metres between cameras and obstacles
    return not any(all(a[i] - margin < eye[i] < b[i] + margin for i in range(3)) for a, b in scene.obstacles)


def _eye(target: Vector, azimuth: Number, elevation: Number, distance: Number) -> Vector:
    flat = distance * math.cos(elevation)
    return add(target, (flat * math.cos(azimuth), flat * math.sin(azimuth), distance * math.sin(elevation)))


def camera_arc(scene: Scene, place: Place, object_height: Number, seed: int) -> tuple[Camera, ...]:
    """Place five cameras on a random short arc that look at the object's place (paper, Sec. 5.2)."""
    rng = random.Random(f"arc-{scene.name}-{seed}")
    # outdoors, a camera that looks steeply down sees only the ground
    highest = 0.45 if scene.world.kind != "color" else 0.8
    target = add(place.location, (0, 0, 0.45 * object_height))
    for _ in range(400):
        azimuth, elevation = rng.uniform(0, 2 * math.pi), rng.uniform(0.12, highest)
        distance = max(0.55, object_height * rng.uniform(2.4, 5.0))
        sweep = rng.uniform(0.25, 0.6)
        field = rng.uniform(0.8, 1.1)
        aim = add(target, (rng.gauss(0, 0.06), rng.gauss(0, 0.06), rng.gauss(0, 0.03)))
        turns = [sweep * (i / (ARC_LENGTH - 1) - 0.5) for i in range(ARC_LENGTH)]
        eyes = [_eye(target, azimuth + turn, elevation, distance) for turn in turns]
        if all(_is_free(scene, eye) for eye in eyes):
            return tuple(Camera(eye, aim, field) for eye in eyes)
    raise ValueError(f"scene {scene.name}: expected room for an arc of cameras around {place.location}, found none")


def capture_cameras(scene: Scene, place: Place, object_height: Number, count: int, seed: int) -> tuple[Camera, ...]:
    """Place cameras all around the object in three rings of different heights, ordered by ring and azimuth."""
    rng = random.Random(f"capture-{scene.name}-{seed}")
    target = add(place.location, (0, 0, 0.4 * object_height))
    cameras: list[Camera] = []
    rings = 3
    for i in range(40 * count):
        if len(cameras) == count:
            break
        even_azimuth = 2 * math.pi * rings * len(cameras) / count
        ring = min(rings - 1, rings * len(cameras) // count)
        # the jitter grows with failed tries, so that obstacles are avoided
        jitter = 1 + (i - len(cameras)) / count
        azimuth = even_azimuth + rng.gauss(0, 0.06) * jitter
        elevation = (0.18, 0.5, 0.85)[ring] + rng.gauss(0, 0.07) * jitter
        distance = max(0.85, object_height * (3.4, 3.0, 3.2)[ring]) * rng.uniform(0.85, 1.25)
        eye = _eye(target, azimuth, min(1.3, max(0.08, elevation)), distance)
        if not _is_free(scene, eye):
            continue
        aim = add(target, (rng.gauss(0, 0.07), rng.gauss(0, 0.07), rng.gauss(0, 0.05)))
        cameras.append(Camera(eye, aim, 1.05))
    if len(cameras) < count:
        raise ValueError(f"scene {scene.name}: expected room for {count} cameras, found {len(cameras)}")
    return tuple(cameras)
