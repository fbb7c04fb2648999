"""Nine benchmark scenes with ground truth (paper, Sec. 7): six indoor, three outdoor.

Two jobs render each scene, which is then written as captures, all with transforms.json, in `<out>/<scene>/`:

    source/                  the object on a pedestal in another light
    target/                  the scene without the object
    ground_truth/            the scene with the object, from the target's cameras
    placement.json           pose of the object in the target
    probe.npy, suns.json     the true light at the object's place

The object has the same coordinates in source and target, rotated about the vertical by the pose's angle, so the
placement is known exactly.
"""

import json
import math
import random
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import images
from splatgraft.core.cameras import Cameras
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_capture, write_capture
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft_paper.synthesis import objects
from splatgraft_paper.synthesis.furniture import Palette, box, cabinet, placed, plant
from splatgraft_paper.synthesis.jobs import Job, RenderSize, SurfaceSampling, Take
from splatgraft_paper.synthesis.places import SUPPLIED_MAPS, make_scene
from splatgraft_paper.synthesis.scene import Material, Part, Place, Scene, World, add, capture_cameras

POSES_DEG = (0.0, 120.0, 240.0)
"""Rotations P0, P1 and P2 of the object in the illumination-consistency scenes, degrees (paper, Table 2)."""


@dataclass(frozen=True)
class BenchmarkScene:
    """Seeds of one benchmark scene."""

    name: str
    kind: str
    seed: int
    """Seed of the scene; no training pair has it."""
    object_seed: int
    pose_deg: float = 0.0
    """Rotation of the object about the vertical between source and target, degrees."""


SCENES: tuple[BenchmarkScene, ...] = (
    BenchmarkScene("living_room_a", "living_room", 9_000_001, 11),
    BenchmarkScene("kitchen", "kitchen", 9_000_002, 12),
    BenchmarkScene("office", "office", 9_000_003, 13),
    BenchmarkScene("bathroom", "bathroom", 9_000_004, 14),
    BenchmarkScene("bedroom", "bedroom", 9_000_005, 15),
    BenchmarkScene("living_room_b", "living_room", 9_000_006, 16),
    BenchmarkScene("terrace", "terrace", 9_000_007, 17),
    BenchmarkScene("garden", "garden", 9_000_008, 18),
    BenchmarkScene("square", "square", 9_000_009, 19),
)
ROTATIONS: tuple[BenchmarkScene, ...] = tuple(
    replace(scene, name=f"{scene.name}_p{i}", pose_deg=angle)
    for scene in (SCENES[0], SCENES[3], SCENES[7])
    for i, angle in enumerate(POSES_DEG)
)


@dataclass(frozen=True)
class BenchmarkSize:
    """Size and number of a capture's views."""

    render: RenderSize
    views: int


SIZES = {"small": BenchmarkSize(RenderSize(352, 248, 16), 40), "paper": BenchmarkSize(RenderSize(), 200)}


def pedestal_scene(seed: int, place: Place) -> Scene:
    """Make the scene in which the object is captured: a pedestal among furniture under an environment map."""
    rng = random.Random(f"stage-{seed}")
    palette = Palette(rng)
    x, y, z = place.location
    top = max(0.5, 3.2 * place.radius)
    stone = replace(palette.stone(), roughness=0.7, scale=2.0)
    pedestal = Part("cylinder", (top, top, 0.4), (x, y, z - 0.2), stone, bevel=0.02)
    ground = box((14, 14, 0.1), (x, y, z - 0.45), Material("tiles", (0.3, 0.29, 0.27), (0.2, 0.2, 0.2), 0.7))
    parts = [pedestal, ground]
    for i in range(5):
        angle = 2 * math.pi * (i + rng.random()) / 5
        made = cabinet(rng, palette, 0.8, rng.uniform(0.4, 0.9)) if i % 2 else plant(rng, palette, 1.0)
        parts += placed(made, (x + 2.6 * math.cos(angle), y + 2.6 * math.sin(angle), z - 0.4), angle - math.pi / 2)
    world = World("environment", path=rng.choice(SUPPLIED_MAPS[:6]), rotation=rng.uniform(0, 6.283))
    return Scene(
        name=f"stage_{seed}",
        kind="stage",
        parts=tuple(parts),
        lamps=(),
        world=world,
        places=(place,),
        bounds=((x - 3, y - 3, z - 0.2), (x + 3, y + 3, z + 3)),
        obstacles=(((x - top / 2, y - top / 2, z - 0.45), (x + top / 2, y + top / 2, z + 0.12)),),
        notes={"world": world.path},
    )


def plan(which: BenchmarkScene, size: BenchmarkSize) -> tuple[Job, Job]:
    """Plan the jobs in the target scene (target, truth, light) and on the pedestal (source, light, surface)."""
    scene = make_scene(which.kind, which.seed)
    place = scene.places[0]
    parts = objects.make(which.object_seed, place)
    height = max(part.location[2] + part.size[2] / 2 for part in parts)
    yaw = random.Random(f"yaw-{which.seed}").uniform(0, 6.283)
    middle = add(place.location, (0, 0, height / 2))

    def job(scene: Scene, yaw: float, seed: int, *takes: Take) -> Job:
        return Job(
            scene=scene,
            objects={"object": placed(parts, place.location, yaw)},
            cameras=capture_cameras(scene, place, height, size.views, seed),
            takes=takes,
            size=size.render,
            provenance={"scene": which.name, "pose_deg": str(which.pose_deg), "licence": "own render"},
        )

    def with_object(name: str) -> Take:
        return Take(name, scene=True, object="object", passes=("color", "mask", "depth"))

    target = job(
        scene, yaw + math.radians(which.pose_deg), which.seed,
        Take("target", scene=True, passes=("color", "depth")),
        with_object("ground_truth"),
        Take("light", scene=True, probe=middle),
    )  # fmt: skip
    surface = SurfaceSampling(40_000, middle)  # for the true normals
    source = job(
        pedestal_scene(which.object_seed, place), yaw, which.object_seed,
        with_object("source"),
        Take("old_light", scene=True, probe=middle),
        Take("surface", scene=False, object="object", surface=surface),
    )  # fmt: skip
    return target, source


def rendered_cameras(out: Path, names: tuple[str, ...]) -> Cameras:
    """Read the cameras of a rendered job and convert them from OpenGL to OpenCV axes."""
    found = json.loads((out / "cameras.json").read_text(encoding="utf-8"))
    poses = torch.tensor(found["poses"], dtype=torch.float64)
    poses[:, :3, 1:3] *= -1
    width, height = found["width"], found["height"]
    focal = [0.5 * width / math.tan(0.5 * angle) for angle in found["field_of_view"]]
    intrinsics = torch.stack([torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]) for f in focal])
    sizes = torch.tensor([[width, height]]).repeat(len(names), 1)
    return Cameras(world_from_camera=poses.float(), intrinsics=intrinsics.float(), sizes=sizes, names=names)


def sparse_points(
    folder: Path, cameras: Cameras, *, count: int = 20_000, noise: float = 0.002, seed: int = 0
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Unproject random pixels by their depth to noisy surface points, as a stand-in for structure from motion.

    Args:
        folder: Pictures and depth maps of a take.
        cameras: Its cameras.
        count: Maximum number of points over all cameras.
        noise: Standard deviation of the depth, relative to the depth.
        seed: Seed of pixels and noise.

    Returns:
        Positions in metres and sRGB colours; the sky has no points.
    """
    generator = np.random.default_rng(seed)
    points, colors = [], []
    for i in range(len(cameras)):
        depth = np.load(folder / f"{i:04d}_depth.npy", allow_pickle=False).astype(np.float32)
        rows, columns = np.nonzero(depth > 0)
        if not len(rows):
            continue
        pick = generator.choice(len(rows), min(count // len(cameras), len(rows)), replace=False)
        u, v = columns[pick], rows[pick]
        z = depth[v, u] * (1 + noise * generator.standard_normal(len(pick)).astype(np.float32))
        k = cameras.intrinsics[i].numpy()
        in_camera = np.stack([(u + 0.5 - k[0, 2]) / k[0, 0] * z, (v + 0.5 - k[1, 2]) / k[1, 1] * z, z], -1)
        pose = cameras.world_from_camera[i].numpy()
        points.append(in_camera @ pose[:3, :3].T + pose[:3, 3])
        colors.append(images.read_rgb(folder / f"{i:04d}.png").numpy()[v, u])
    return torch.from_numpy(np.concatenate(points)).float(), torch.from_numpy(np.concatenate(colors)).float()


def gather_capture(rendered: Path, take: str, out: Path, *, passes: tuple[str, ...], points: bool) -> None:
    """Copy one take into a capture: images/, a folder per pass, transforms.json, points.ply."""
    count = len(json.loads((rendered / "cameras.json").read_text(encoding="utf-8"))["poses"])
    stems = tuple(f"{i:04d}" for i in range(count))
    for folder, suffix, ending in _PASS_FILES:
        if folder in passes:
            (out / folder).mkdir(parents=True, exist_ok=True)
            for stem in stems:
                shutil.copyfile(rendered / take / f"{stem}{suffix}", out / folder / f"{stem}{ending}")
    cameras = rendered_cameras(rendered, tuple(f"{stem}.png" for stem in stems))
    found, colors = sparse_points(rendered / take, cameras) if points else (torch.zeros(0, 3), torch.zeros(0, 3))
    image_paths, mask_paths = (tuple(out / name / f"{stem}.png" for stem in stems) for name in ("images", "masks"))
    write_capture(out, PosedImages(image_paths, cameras, found, colors, mask_paths if "masks" in passes else ()))


# folder of a capture, and the ends of the names of its files in a take and in the capture
_PASS_FILES = (("images", ".png", ".png"), ("masks", "_mask.png", ".png"), ("depth", "_depth.npy", ".npy"))


def gather(which: BenchmarkScene, target_render: Path, source_render: Path, out: Path) -> None:
    """Write one rendered scene as captures, with its placement, its true lights and surface points of the object."""
    gather_capture(source_render, "source", out / "source", passes=("images", "masks"), points=True)
    gather_capture(target_render, "target", out / "target", passes=("images",), points=True)
    passes = ("images", "masks", "depth")
    gather_capture(target_render, "ground_truth", out / "ground_truth", passes=passes, points=False)
    scene = make_scene(which.kind, which.seed)
    angle = math.radians(which.pose_deg)
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    center = torch.tensor(scene.places[0].location)
    moved = Similarity(scale=1.0, rotation=rotation, translation=center - rotation @ center)
    write_placement(out / "placement.json", Placement((ObjectPlacement(moved),)))
    (out / "old_light").mkdir(exist_ok=True)
    for given, name in (
        (target_render / "light" / "0000.npy", "probe.npy"),
        (target_render / "light" / "suns.json", "suns.json"),
        (source_render / "old_light" / "0000.npy", "old_light/0000.npy"),
        (source_render / "old_light" / "suns.json", "old_light/suns.json"),
        (source_render / "surface" / "0000.npy", "surface.npy"),
    ):
        shutil.copyfile(given, out / name)
    record = {"kind": which.kind, "pose_deg": which.pose_deg, "seed": which.seed, **scene.notes}
    (out / "scene.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def find_defect(folder: Path) -> str | None:
    """Describe the first missing, broken, black, clipped or empty picture of a scene in one line, or return None."""
    try:
        for name in ("ground_truth", "target", "source"):
            capture = read_capture(folder / name)
            found = (_find_view_defect(capture, index, masked=name != "target") for index in range(len(capture)))
            if defect := next(filter(None, found), None):
                return defect
    except ValueError as error:
        return str(error)
    return None


def _find_view_defect(capture: PosedImages, index: int, *, masked: bool) -> str | None:
    path, image = capture.image_paths[index], capture.image(index)
    mean, deviation, clipped = float(image.mean()), float(image.std()), float((image > 0.995).float().mean())
    if mean < 0.02 or deviation < 0.01 or clipped > 0.6:  # set by hand, like the limits of the mask
        found = f"mean {mean:.3f}, deviation {deviation:.3f}, {clipped:.0%} clipped"
        return f"{path}: expected a lit picture, found {found}"
    mask = capture.mask(index) if masked else None
    if masked and mask is None:
        return f"{path}: expected a mask beside it, found none"
    if mask is not None and not 0.001 <= float(mask.mean()) <= 0.7:
        return f"{capture.mask_paths[index]}: expected a mask of 0.1% to 70%, found {float(mask.mean()):.2%}"
    return None
