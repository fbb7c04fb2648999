"""Measure poses of 360-degree panoramas, and the light with and without them, on scenes of `panorama_scenes.py`.

    .venv-blender/bin/python benchmarks/panorama_scenes.py garden build/garden
    python benchmarks/panoramas.py build/garden [...]

The light is estimated 0.7 m above the middle, from the photos alone and from photos and panoramas together, with the
same reconstruction options. The true light is known: an even sky and a sun, or a lamp.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splatgraft.capture import pose_photos
from splatgraft.capture.panoramas import panorama_from_views
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_capture
from splatgraft.formats.captures.masks import find_photos
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import estimate_light
from splatgraft.relighting.light.panorama import NoLight

OPTIONS = ReconstructOptions(quality="standard", iterations=1000, budget=20_000, resolution=1.0)
PLACE = BoundingSphere(torch.tensor([0.0, 0.0, 0.7]), 0.25)
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def similarity(truth: np.ndarray, found: np.ndarray) -> Similarity:
    """Return the best similarity from found to true positions (Umeyama 1991)."""
    x, y = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(y.T @ x)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale, rotation = (s * np.diag(sign)).sum() / (x**2).sum(), u @ sign @ vt
    parts = (torch.from_numpy(part).float() for part in (rotation, truth.mean(0) - scale * rotation @ found.mean(0)))
    return Similarity(float(scale), *parts)


def posed_panoramas(folder: Path, work: Path) -> PosedImages:
    """Pose the panoramas, print the errors, and return their views in the true frame."""
    posed, report = pose_photos(find_photos(folder / "panoramas"), work, scratch=work / "scratch")
    truth = np.array(json.loads((folder / "truth.json").read_text("utf-8"))["panoramas"]) @ OPENCV_FROM_OPENGL
    stems = [name.rsplit("_", 1)[0] for name in posed.cameras.names[::8]]
    truth = truth[[int(stem) for stem in stems]]
    move = similarity(truth[:, :3, 3], posed.cameras.centers[::8].double().numpy())
    views = move.cameras(posed.cameras)
    errors = np.linalg.norm(views.centers[::8].numpy() - truth[:, :3, 3], axis=1)
    wanted = truth[:, None, :3, :3] @ panorama_from_views()[:, :3, :3].double().numpy()
    cosine = (np.einsum("pvij,pvij->pv", wanted, views.world_from_camera[:, :3, :3].reshape(-1, 8, 3, 3)) - 1) / 2
    extent = np.ptp(truth[:, :3, 3], axis=0).max()
    print(
        f"{folder.name}: {report}; doubts: {len(report.doubts)}; positions off by {errors.mean():.4f} m, at most "
        f"{errors.max():.4f}, {errors.max() / extent:.2%} of their extent of {extent:.2f} m; "
        f"directions off by at most {np.rad2deg(np.arccos(cosine.clip(-1, 1))).max():.2f} degrees"
    )
    return replace(posed, cameras=views, points=move.points(posed.points))


def joined(one: Cameras, other: Cameras) -> Cameras:
    parts = (
        torch.cat([getattr(c, name) for c in (one, other)]) for name in ("world_from_camera", "intrinsics", "sizes")
    )
    return Cameras(*parts, names=(*one.names, *other.names))


def measure(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        views, photos = posed_panoramas(folder, Path(name)), read_capture(folder)
        # both begin from the same points
        alone = replace(photos, points=views.points, point_colors=views.point_colors)
        both = replace(
            alone,
            image_paths=(*photos.image_paths, *views.image_paths),
            cameras=joined(photos.cameras, views.cameras),
        )
        for title, capture in (("photos", alone), ("photos and panoramas", both)):
            report_light(f"{folder.name}, {title}", capture, json.loads((folder / "truth.json").read_text("utf-8")))


def report_light(title: str, capture: PosedImages, truth: dict[str, list[float]]) -> None:
    """Print the direction of the strongest source, its share of the light on the ground, and the colour of the rest."""
    found = estimate_light(CapturedScene(reconstruct(capture, OPTIONS), capture.cameras), PLACE)
    if isinstance(found, NoLight):
        print(f"{title}: no light: {found.reason}")
        return
    toward = torch.tensor(truth["sun"]) if "sun" in truth else torch.tensor(truth["lamp"]) - PLACE.center
    toward = torch.nn.functional.normalize(toward, dim=0)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    light, lines = found.light, []
    for source in light.sources:
        off = float(torch.rad2deg(torch.acos((torch.tensor(source.direction) @ toward).clamp(-1, 1))))
        lines.append(f"{source.name} {off:.1f} degrees off, irradiance {source.luminance:.2f}")
    rest = replace(light, sources=()).irradiance(up)[0]
    shown = "; ".join(lines) or "no source"
    print(
        f"{title}: {shown}; ambient on the ground {', '.join(f'{v:.2f}' for v in rest.tolist())}; "
        f"captured {light.coverage:.0%}, of the sky {1 - light.unseen_up:.0%}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    for each in parser.parse_args().folders:
        measure(each)
