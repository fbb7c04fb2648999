"""Score and figures of a model.

The score is the share of photos with a pose times the share of verified matches that the model explains. A match is
explained if both its features observe one point. At least `MIN_TRACK` photos must observe this point, with a mean
error of at most `MAX_ERROR_PX`. Unlike the reprojection error, the score counts the matches that COLMAP dropped.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .job import MAX_ERROR_PX, MIN_INLIERS, MIN_TRACK

_EPIPOLAR_PX = 4.0  # largest Sampson error of a match that two poses explain (COLMAP: max_error of a pair)
_AGREED = 0.5  # smallest share of the object's matches that the poses of a pair explain if they are right

ALIKE = 0.99
"""Smallest ratio of a score to the best one at which two models count as equally good."""

Answer = dict[str, Any]
"""A model as plain numbers: images with poses and cameras, points, and score."""
Matches = list[tuple[int, int, np.ndarray]]
"""Ids of two photos and the ids of their matching features (n, 2), for each pair."""


def read_matches(database: Path) -> Matches:
    """Read the verified matches of all pairs."""
    with pycolmap.Database.open(database) as opened:
        pairs, geometries = opened.read_two_view_geometries()
    return [
        (*pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches)
        for pair, geometry in zip(pairs, geometries, strict=True)
        if len(geometry.inlier_matches)
    ]


def best_of(database: Path, models: list[Any], photos: int) -> Answer:
    """Return the best of `models` as plain numbers, without images if there are no models.

    Among models of nearly equal score, the one with the smallest reprojection error is best, because a model with a
    wrong lens can also explain nearly all matches.
    """
    if not models:
        return {"images": [], "points": [], "mean_reprojection_px": 0.0, "explained": 0.0, "score": 0.0}
    matches = read_matches(database)
    scores = [posed_and_explained(matches, model) for model in models]
    alike = [i for i, score in enumerate(scores) if score >= ALIKE * max(scores)]
    best = min(alike, key=lambda i: models[i].compute_mean_reprojection_error())
    return _numbers(matches, models[best]) | {"score": scores[best] / photos}


def posed_and_explained(matches: Matches, model: Any) -> float:
    """Compute the number of photos with a reliable pose times the explained share of `matches`."""
    seen = _seen_points(model)
    return len(seen) * _count_explained(seen, matches) / _count(matches)


def explained_shares(matches: Matches, model: Any) -> dict[int, float]:
    """Compute, for each photo with a pose, the explained share of its matches with other posed photos."""
    seen = _seen_points(model)
    counts = {i: np.zeros(2) for i in model.reg_image_ids()}
    for a, b, rows in matches:
        if a in counts and b in counts:
            for i in (a, b):
                counts[i] += (_explained(seen, a, b, rows), len(rows))
    return {i: float(explained / total) for i, (explained, total) in counts.items() if total}


def moved_photos(database: Path, answer: Answer, masks: Path) -> list[str]:
    """Find photos whose poses contradict the matches on the object, because it was moved or turned between photos.

    Two photos agree on the object if their poses explain half of its matches. Photos that agree, directly or through
    others, are a group. A group contradicts the largest one if it does not agree with a photo of it that has enough
    matches. Photos with too few matches on the object contradict nothing.

    Args:
        database: Verified matches of the features inside the masks.
        answer: The model.
        masks: Folder of the masks; photos without one contradict nothing.

    Returns:
        Names of the photos of all groups that contradict the largest one.
    """
    posed = [image for image in answer["images"] if (masks / f"{image['name']}.png").is_file()]
    group = {image["name"]: image["name"] for image in posed}

    def root(name: str) -> str:
        while group[name] != name:
            name = group[name]
        return name

    apart: list[tuple[str, str]] = []
    for a, b, _, share in agreements(database, posed):
        if share >= _AGREED:
            group[root(a)] = root(b)
        else:
            apart.append((a, b))
    sizes = Counter(map(root, group))
    largest = max(sizes, key=lambda name: sizes[name], default="")
    pairs = [{root(a), root(b)} for a, b in apart]
    against = {one for pair in pairs if largest in pair for one in pair} - {largest}
    return sorted(name for name in group if root(name) in against)


def agreements(database: Path, images: list[dict[str, Any]]) -> list[tuple[str, str, int, float]]:
    """Compute the share of matches that two poses explain, for each pair of `images` with enough verified matches.

    Returns:
        Names of both photos, the number of their matches, and the share of these within 4 px of their epipolar lines.
    """
    posed = {image["name"]: image for image in images if image["camera"]}  # panoramas have no lens
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images() if image.name in posed}
        rays = {i: _rays(posed[name]["camera"], opened.read_keypoints(i)[:, :2]) for i, name in names.items()}
    found: list[tuple[str, str, int, float]] = []
    for a, b, rows in read_matches(database):
        if a in names and b in names and len(rows) >= MIN_INLIERS:
            errors = _sampson_px(posed[names[a]], posed[names[b]], rays[a][rows[:, 0]], rays[b][rows[:, 1]])
            found.append((names[a], names[b], len(rows), float((errors <= _EPIPOLAR_PX).mean())))
    return found


def _rays(camera: list[float], keypoints: np.ndarray) -> np.ndarray:
    """Compute the directions (n, 3) of pixels, scaled to depth 1."""
    opencv = pycolmap.Camera(model="OPENCV", width=1, height=1, params=camera)
    rays = np.ones((len(keypoints), 3))
    rays[:, :2] = opencv.cam_from_img(np.asarray(keypoints, np.float64))
    return rays


def _sampson_px(one: dict[str, Any], other: dict[str, Any], rays: np.ndarray, matched: np.ndarray) -> np.ndarray:
    """Compute the Sampson errors of matches under the poses of two photos, pixels."""
    first, second = (np.array(image["world_from_camera"]) for image in (one, other))
    rotation = second[:, :3].T @ first[:, :3]
    x, y, z = second[:, :3].T @ (first[:, 3] - second[:, 3])
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines, back = rays @ essential.T, matched @ essential
    slopes = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    errors = np.abs((matched * lines).sum(1)) / np.sqrt(np.maximum(slopes, 1e-30))
    return errors * min(one["camera"][0], other["camera"][0])


def connected_photos(database: Path) -> int:
    """Count the photos that can get a pose because they have enough verified matches with another photo."""
    return len({i for *pair, rows in read_matches(database) if len(rows) >= MIN_INLIERS for i in pair})


def _count(matches: Matches) -> int:
    return max(sum(len(rows) for *_, rows in matches), 1)


def _count_explained(seen: dict[int, np.ndarray], matches: Matches) -> int:
    return sum(_explained(seen, *match) for match in matches)


def _explained(seen: dict[int, np.ndarray], a: int, b: int, rows: np.ndarray) -> int:
    if a not in seen or b not in seen:
        return 0
    points = seen[a][rows[:, 0]]
    return int(((points >= 0) & (points == seen[b][rows[:, 1]])).sum())


def _seen_points(model: Any) -> dict[int, np.ndarray]:
    """Return, for each photo with a reliable pose, the reliable point of each of its features, or -1."""
    counts = {i for i, p in model.points3D.items() if p.track.length() >= MIN_TRACK and p.error <= MAX_ERROR_PX}
    seen = {
        i: np.array([p.point3D_id if p.point3D_id in counts else -1 for p in image.points2D], dtype=np.int64)
        for i, image in model.images.items()
        if image.has_pose
    }
    return {i: points for i, points in seen.items() if (points >= 0).sum() >= MIN_INLIERS}


def _numbers(matches: Matches, model: Any) -> Answer:
    seen = _seen_points(model)
    return {
        "explained": _count_explained(seen, matches) / _count(matches),
        "mean_reprojection_px": float(model.compute_mean_reprojection_error()),
        "images": [
            {
                "name": image.name,
                "world_from_camera": image.cam_from_world().inverse().matrix().tolist(),
                "camera": lens_numbers(model.cameras[image.camera_id]),
                "camera_id": image.camera_id,
                "observations": int((seen[image.image_id] >= 0).sum()),
            }
            for image in sorted(model.images.values(), key=lambda image: image.name)
            if image.image_id in seen
        ],
        "points": [
            [*p.xyz.tolist(), *(int(c) for c in p.color), float(p.error), p.track.length()]
            for p in model.points3D.values()
        ],
    }


def lens_numbers(camera: Any) -> list[float]:
    """Return fx, fy, cx, cy, k1, k2, p1, p2 of a camera with a SIMPLE_RADIAL or OPENCV lens; none of a panorama."""
    numbers = camera.params.tolist()
    if len(numbers) == 8:
        return numbers
    if camera.model == pycolmap.CameraModelId.EQUIRECTANGULAR:
        return []
    f, cx, cy, k = numbers
    return [f, f, cx, cy, k, 0.0, 0.0, 0.0]


def photo_figures(database: Path, answer: Answer) -> list[dict[str, Any]]:
    """Return name, features, most matches with one other photo and whether it was moved, for all photos."""
    most: dict[int, int] = {}
    for *pair, rows in read_matches(database):
        for i in pair:
            most[i] = max(most.get(i, 0), len(rows))
    with pycolmap.Database.open(database) as opened:
        return [
            {
                "name": image.name,
                "features": opened.num_keypoints_for_image(image.image_id),
                "matches": most.get(image.image_id, 0),
                "moved": image.name in answer["moved"],
            }
            for image in sorted(opened.read_all_images(), key=lambda image: image.name)
        ]
