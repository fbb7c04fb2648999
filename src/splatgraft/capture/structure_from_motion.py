"""Structure from motion: camera poses, intrinsics and sparse points of photos, computed by COLMAP.

COLMAP runs in a process of its own (colmap_process/). Its model is checked, undistorted and set upright here.
"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from splatgraft.capture.colmap_process.job import MAX_ERROR_PX, MIN_TRACK, PHASES, Job
from splatgraft.capture.panoramas import CUT_BELOW, are_panoramas, cut_views, panorama_from_views
from splatgraft.capture.photos import camera_groups, working_copies, working_masks, write_undistorted
from splatgraft.capture.pose_report import Lens, PoseReport, Unposed, find_doubts
from splatgraft.capture.usable_views import past_subject
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.capture_orientation import estimate_up, quarter_turns
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import stored_size, write_image
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.rotations import rotation_to_z
from splatgraft.core.similarity import Similarity
from splatgraft.formats.captures.masks import PhotoFiles
from splatgraft.runtime.process import last_line, run_logged
from splatgraft.runtime.progress import Progress, silent

_ADVICE = (
    "take more photos, a step apart, with two thirds overlap, sharp, of a still scene with texture around plain or "
    "shiny things, at one zoom setting (or say that each photo has its own camera: lens = each)"
)
_EXHAUSTIVE = 80  # largest number of photos for which all pairs are matched by default
MIN_POSED_SHARE = 0.5
"""Smallest share of photos with a pose; photos without one are named and left out."""
_AGREED = 0.6  # smallest share of a group's matches that right poses explain; 0.7 for the least photo of 7 captures
_PANORAMA_SIZE = 4  # size of a panorama over that of a photo, because a view has a quarter of its width
_THOROUGH_COST = 40  # time of a thorough attempt over that of a quick one (more, affine features; guided matching)


@dataclass(frozen=True)
class PoseOptions:
    """Options of structure from motion."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Pairs that are matched first: all, or neighbours in name order; `auto` is exhaustive for up to 80 photos."""
    effort: Literal["auto", "quick", "thorough"] = "auto"
    """`thorough` finds and matches more features at about 20 times the cost; `auto` does so if quick poses
    fewer than half of the photos."""
    lens: Literal["shared", "each"] = "shared"
    """Whether photos of equal size and EXIF (maker, model, focal length) share a camera, or each has its own."""
    max_size_px: int = 1600
    """Longest side to which larger photos are reduced first, pixels."""
    threads: int = 2
    """CPU threads."""
    seed: int = 0
    """Seed of the random choices of matching and mapping."""


def predict_pose_seconds(photos: int) -> float:
    """Predict the seconds of a quick attempt on two idle cores, within a factor of 2."""
    return 1.7 * photos  # 80 photos of 1280 px took 118 s, 50 of 1600 px 91 s


def pose_photos(
    photos: PhotoFiles,
    workspace: Path,
    *,
    scratch: Path,
    options: PoseOptions = PoseOptions(),
    progress: Progress = silent,
    say: Callable[[str], None] = lambda sentence: None,
) -> tuple[PosedImages, PoseReport]:
    """Compute poses, intrinsics and sparse points of photos, and write the undistorted images.

    The images go to `workspace`/images, upright; undistorted masks go to `workspace`/masks. In the world, +z is up, the
    support plane is z = 0, and the median camera distance is 1 (see `upright`).

    Args:
        photos: At least three photos with different names; masks restrict the features if whole photos give too few.
        workspace: An existing folder.
        scratch: Folder for features, matches and models, made if missing. A run of the same photos and options
            continues from what a killed run left there.
        options: Options of structure from motion.
        progress: Called with parts done, parts in all and a short text.
        say: Called with one sentence before a long part, and with the time that each part took.

    Raises:
        ValueError: pycolmap is missing, COLMAP fails, or fewer than half of the photos get a pose.
    """
    if find_spec("pycolmap") is None:
        raise ValueError("photos without poses: expected pycolmap (pip install 'splatgraft[sfm]'), found none")
    if len(photos.paths) < 3:
        raise ValueError(f"{workspace}: expected at least 3 photos to pose, found {len(photos.paths)}")
    efforts = ("quick", "thorough") if options.effort == "auto" else (options.effort,)
    total = len(PHASES) * len(efforts) + 1
    scratch.mkdir(exist_ok=True)
    progress(0, total, "reading photos")
    panoramas = are_panoramas(photos.paths)
    size_px = options.max_size_px * (_PANORAMA_SIZE if panoramas else 1)
    copies = working_copies(photos.paths, scratch / "photos", size_px)
    if panoramas:
        say(f"{len(copies)} panoramas of 360 degrees: each gives 8 views, without what is below the camera")
    masks = {} if panoramas else working_masks(photos.masks, copies, scratch / "masks")
    found: list[tuple[dict[str, Any], PoseReport]] = []
    for attempt, effort in enumerate(efforts):

        def advance(done: int, message: str, before: int = attempt * len(PHASES)) -> None:
            progress(before + done, total, message)

        model = _run(_job(copies, masks, options, scratch / effort, panoramas=panoramas), advance, say)
        model = _without_astray(model, copies[0].parent)
        found.append((model, _report(model, copies)))
        seconds, cpu = (sum(model[name].values()) for name in ("seconds", "cpu_seconds"))
        parts = ", ".join(f"{phase} {took:.0f}" for phase, took in model["seconds"].items())
        say(f"structure from motion took {seconds:.0f} s ({parts}), {cpu:.0f} CPU-s")
        latest = found[-1][1]
        minutes = max(1, round(_THOROUGH_COST * seconds / 60))
        if latest.registered >= MIN_POSED_SHARE * len(copies):
            if latest.doubts and effort == "quick":
                doubts = "; ".join(map(str, latest.doubts))
                say(f'poses are doubtful ({doubts}); effort = "thorough" finds more features, in about {minutes} min')
            break
        if effort != efforts[-1]:
            say(
                f"only {latest.registered} of {len(copies)} photos got a pose: structure from motion runs again with "
                f"more features, which takes about {minutes} min"
            )
    # the score of colmap_process/scores.py; both attempts have the same number of photos
    model, report = max(found, key=lambda pair: pair[1].explained * pair[1].registered)
    if report.registered < MIN_POSED_SHARE * len(copies):
        raise ValueError(
            f"{photos.paths[0].parent}: expected at least half of {len(copies)} photos to register, "
            f"found {report.registered}; {_ADVICE}; without a pose: {report.reasons}"
        )
    progress(total - 1, total, "undistorting")
    if panoramas:
        posed, on_their_side = _panorama_views(model, copies[0].parent, workspace), 0
    else:
        posed, on_their_side = _posed_images(model, copies[0].parent, masks, workspace)
    if on_their_side:
        say(f"{on_their_side} of {len(posed)} photos lay on their side or upside down and were turned upright")
    progress(total, total, str(report))
    return posed, report


def _without_astray(model: dict[str, Any], photos: Path) -> dict[str, Any]:
    """Remove groups of photos that look past the subject and contradict the matches with the photos that show it."""
    images = [image for image in model["images"] if image["camera"]]
    if not images:
        return model
    intrinsics = [[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] for fx, fy, cx, cy, *_ in (i["camera"] for i in images)]
    cameras = Cameras(
        world_from_camera=torch.tensor([[*image["world_from_camera"], [0, 0, 0, 1]] for image in images]),
        intrinsics=torch.tensor(intrinsics),
        sizes=torch.tensor([stored_size(photos / image["name"]) for image in images]),
        names=tuple(image["name"] for image in images),
    )
    past, index = past_subject(cameras), {name: i for i, name in enumerate(cameras.names)}
    if not bool(past.any()):
        return model
    agreed = torch.zeros(len(images), len(images))  # matches of two photos, positive if most agree with their poses
    for a, b, matches, share in model["agreements"]:
        agreed[index[a], index[b]] = agreed[index[b], index[a]] = matches * (share - _AGREED)
    _, group = connected_components(agreed[past][:, past].clamp_min(0).numpy(), directed=False)
    with_others = np.bincount(group, weights=agreed[past][:, ~past].sum(1).numpy())
    astray = {cameras.names[i] for i, g in zip(past.nonzero()[:, 0].tolist(), group, strict=True) if with_others[g] < 0}
    return {
        **model,
        "images": [image for image in model["images"] if image["name"] not in astray],
        "photos": [photo | {"astray": photo["name"] in astray} for photo in model["photos"]],
    }


def _report(model: Mapping[str, Any], copies: Sequence[Path]) -> PoseReport:
    by_camera: dict[int, list[dict[str, Any]]] = {}
    for image in filter(lambda image: image["camera"], model["images"]):  # panoramas have no lens
        by_camera.setdefault(image["camera_id"], []).append(image)
    lenses = tuple(
        Lens(
            photos=tuple(Path(image["name"]).stem for image in images),
            size=stored_size(copies[0].with_name(images[0]["name"])),
            focal_px=images[0]["camera"][0],
            distortion=images[0]["camera"][4],
        )
        for images in sorted(by_camera.values(), key=len, reverse=True)
    )
    posed = {image["name"] for image in model["images"]}
    unposed = [photo for photo in model["photos"] if photo["name"] not in posed]
    figures = {name: model[name] for name in ("explained", "mean_reprojection_px")}
    observations = [image["observations"] for image in model["images"]]
    return PoseReport(
        photos=len(copies),
        registered=len(model["images"]),
        missing=tuple(Unposed(**photo | {"name": Path(photo["name"]).stem}) for photo in unposed),
        points=len(_good_points(model)),
        models=model["models"],
        method=model["method"],
        lenses=lenses,
        doubts=find_doubts(len(copies), observations, lenses=lenses, **figures),
        **figures,
    )


def _good_points(model: Mapping[str, Any]) -> Float[Tensor, "m 8"]:
    """Return the reliable sparse points: position, colour in bytes, error in pixels, number of photos that see it."""
    rows = torch.tensor(model["points"]).reshape(-1, 8)
    return rows[(rows[:, 7] >= MIN_TRACK) & (rows[:, 6] <= MAX_ERROR_PX)]


def _job(
    copies: Sequence[Path], masks: Mapping[str, Path], options: PoseOptions, scratch: Path, *, panoramas: bool
) -> Job:
    scratch.mkdir(exist_ok=True)
    lens = {}
    if panoramas:
        width, height = stored_size(copies[0])
        write_image(
            below := scratch / "below.png",
            (torch.arange(height) < CUT_BELOW * height)[:, None].expand(height, width).float(),
        )
        lens = {"camera_model": "EQUIRECTANGULAR", "common_mask": str(below.resolve())}
    return Job(
        photos=str(copies[0].parent.resolve()),
        masks=str(next(iter(masks.values())).parent.resolve()) if masks else "",
        scratch=str(scratch.resolve()),
        thorough=scratch.name == "thorough",
        groups=camera_groups(copies, shared=options.lens == "shared"),
        exhaustive=options.matching == "exhaustive" or (options.matching == "auto" and len(copies) <= _EXHAUSTIVE),
        threads=options.threads,
        seed=options.seed,
        **lens,
    )


def _run(job: Job, advance: Callable[[int, str], None], say: Callable[[str], None]) -> dict[str, Any]:
    """Run the COLMAP process, or read its result if an earlier run finished it."""
    if not job.output.is_file():
        program, log = Path(__file__).with_name("colmap_process"), job.folder / "log"
        log.unlink(missing_ok=True)
        effort = "thorough" if job.thorough else "quick"

        def hear(line: str) -> None:
            first, _, rest = line.partition(" ")
            if first.isdigit():
                advance(int(first), f"{rest} ({effort})")
            elif first == "-":
                say(rest)

        code = run_logged([sys.executable, str(program), json.dumps(asdict(job))], log, stdin=None, on_line=hear)
        if code != 0 or not job.output.is_file():
            last = last_line(log) or "no message"
            raise ValueError(f"{job.photos}: expected COLMAP to finish, found exit code {code}: {last}")
    return json.loads(job.output.read_text(encoding="utf-8"))


def _posed_images(
    model: Mapping[str, Any], photos: Path, masks: Mapping[str, Path], workspace: Path
) -> tuple[PosedImages, int]:
    """Return the photos, undistorted and upright, and the number of photos that were turned."""
    (workspace / "images").mkdir(exist_ok=True)
    if masks:
        (workspace / "masks").mkdir(exist_ok=True)
    poses = torch.tensor([[*image["world_from_camera"], [0, 0, 0, 1]] for image in model["images"]])
    turns = quarter_turns(poses)
    intrinsics, sizes, paths = [], [], []
    mask_paths: list[Path | None] = []
    for image, quarters in zip(model["images"], turns.tolist(), strict=True):
        copy, path = photos / image["name"], workspace / "images" / image["name"]
        fx, fy, cx, cy, *coefficients = image["camera"]
        size = stored_size(copy)
        matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        distortion = Distortion(matrix, torch.tensor([*coefficients, 0], dtype=torch.float64), size)
        mask = (masks[copy.name], workspace / "masks" / f"{copy.stem}.png") if copy.name in masks else None
        intrinsics.append(write_undistorted(copy, path, distortion, mask=mask, quarters=quarters))
        mask_paths.append(mask[1] if mask else None)
        sizes.append(size)
        paths.append(path)
    cameras = Cameras(
        world_from_camera=poses,
        intrinsics=torch.stack(intrinsics),
        sizes=torch.tensor(sizes),
        names=tuple(path.name for path in paths),
    ).turned(turns)
    posed = _set_upright(cameras, paths, _good_points(model))
    return replace(posed, mask_paths=tuple(mask_paths) if masks else ()), int((turns > 0).sum())


def _panorama_views(model: Mapping[str, Any], photos: Path, workspace: Path) -> PosedImages:
    """Return the views of all posed panoramas, upright."""
    (workspace / "images").mkdir(exist_ok=True)
    paths = [file for image in model["images"] for file in cut_views(photos / image["name"], workspace / "images")]
    poses = torch.tensor([[*image["world_from_camera"], [0, 0, 0, 1]] for image in model["images"]])
    side = stored_size(paths[0])[0]
    views = (poses[:, None] @ panorama_from_views()).flatten(0, 1)
    cameras = pinhole(views, side / 2, width=side, height=side)
    return _set_upright(replace(cameras, names=tuple(path.name for path in paths)), paths, _good_points(model))


def _set_upright(cameras: Cameras, paths: Sequence[Path], points: Float[Tensor, "m 8"]) -> PosedImages:
    upright_from_sfm = upright(cameras, points[:, :3])
    return PosedImages(
        image_paths=tuple(paths),
        cameras=upright_from_sfm.cameras(cameras),
        points=upright_from_sfm.points(points[:, :3]),
        point_colors=points[:, 3:6] / 255,
    )


def upright(cameras: Cameras, points: Float[Tensor, "m 3"]) -> Similarity:
    """Compute upright_from_world: +z is up, the support plane is z = 0, and the median point lies above the origin.

    Without a clear support plane, the median point is the origin. The cameras' median distance from the median point
    becomes 1, because structure from motion has no scale.
    """
    up = estimate_up(cameras)
    plane = dominant_level_plane(points, up)
    up = up if plane is None else plane.normal
    middle = points.median(0).values if len(points) else cameras.centers.mean(0)
    height = up @ middle if plane is None else plane.offset
    distance = (cameras.centers - middle).norm(dim=1).median()
    scale = float(1 / distance) if distance > 0 else 1.0
    rotation = rotation_to_z(up)
    return Similarity(
        scale=scale, rotation=rotation, translation=-scale * (rotation @ (middle + up * (height - up @ middle)))
    )
