"""Cameras of synthetic scenes: short arcs for training pairs, full captures for the benchmark."""

import math
import random

from splatgraft_paper.synthesis.scene import Camera, Number, Place, Scene, Vector

ARC_LENGTH = 5
"""Views per camera arc (paper, Sec. 5.2)."""


_OBSTACLE_MARGIN = 0.12
"""Metres between cameras and obstacles."""
_ARC_TRIES, _CAPTURE_TRIES = 400, 40
"""Random draws of an arc, and per camera of a capture."""


def _is_free(scene: Scene, eye: Vector) -> bool:
    low, high = scene.bounds
    if any(not low[i] <= eye[i] <= high[i] for i in range(3)):
        return False
    margin = _OBSTACLE_MARGIN
    return not any(all(a[i] - margin < eye[i] < b[i] + margin for i in range(3)) for a, b in scene.obstacles)


def _eye(target: Vector, azimuth: Number, elevation: Number, distance: Number) -> Vector:
    flat = distance * math.cos(elevation)
    return (
        target[0] + flat * math.cos(azimuth),
        target[1] + flat * math.sin(azimuth),
        target[2] + distance * math.sin(elevation),
    )


def camera_arc(scene: Scene, place: Place, object_height: Number, seed: int) -> tuple[Camera, ...]:
    """Place five cameras on a random short arc that look at the object's place (paper, Sec. 5.2).

    Args:
        scene: gives bounds and obstacles.
        place: of the object.
        object_height: metres.
        seed: of the arc.

    Raises:
        ValueError: no free arc is found.
    """
    rng = random.Random(f"arc-{scene.name}-{seed}")
    # outdoors, a camera that looks steeply down sees only the ground
    highest = 0.45 if scene.world.kind != "color" else 0.8
    target = (place.location[0], place.location[1], place.location[2] + 0.45 * object_height)
    for _ in range(_ARC_TRIES):
        azimuth, elevation = rng.uniform(0, 2 * math.pi), rng.uniform(0.12, highest)
        distance = max(0.55, object_height * rng.uniform(2.4, 5.0))
        sweep = rng.uniform(0.25, 0.6)
        field = rng.uniform(0.8, 1.1)
        aim = (target[0] + rng.gauss(0, 0.06), target[1] + rng.gauss(0, 0.06), target[2] + rng.gauss(0, 0.03))
        eyes = [
            _eye(target, azimuth + sweep * (i / (ARC_LENGTH - 1) - 0.5), elevation, distance) for i in range(ARC_LENGTH)
        ]
        if all(_is_free(scene, eye) for eye in eyes):
            return tuple(Camera(eye, aim, field) for eye in eyes)
    raise ValueError(f"scene {scene.name}: expected room for an arc of cameras around {place.location}, found none")


def capture_cameras(scene: Scene, place: Place, object_height: Number, count: int, seed: int) -> tuple[Camera, ...]:
    """Place cameras all around the object in three rings of different heights, ordered by ring and azimuth.

    Args:
        scene: gives bounds and obstacles.
        place: of the object.
        object_height: metres.
        count: number of cameras.
        seed: of the jitter.

    Raises:
        ValueError: too little of the surroundings is free.
    """
    rng = random.Random(f"capture-{scene.name}-{seed}")
    target = (place.location[0], place.location[1], place.location[2] + 0.4 * object_height)
    cameras: list[Camera] = []
    rings = 3
    for i in range(count * _CAPTURE_TRIES):
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
        aim = (target[0] + rng.gauss(0, 0.07), target[1] + rng.gauss(0, 0.07), target[2] + rng.gauss(0, 0.05))
        cameras.append(Camera(eye, aim, 1.05))
    if len(cameras) < count:
        raise ValueError(f"scene {scene.name}: expected room for {count} cameras, found {len(cameras)}")
    return tuple(cameras)
