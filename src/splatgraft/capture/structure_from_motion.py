"""Poses, intrinsics and sparse points of photos by COLMAP, which runs in a process of its own (colmap_process.py)."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch

from splatgraft.capture.orientation import upright
from splatgraft.capture.photos import camera_groups, working_copies, write_undistorted
from splatgraft.capture.plausibility import Doubt, Found, Lens, find_doubts
from splatgraft.capture.pose_report import PoseReport
from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import stored_size
from splatgraft.core.posed_images import PosedImages
from splatgraft.runtime.progress import Progress, silent

_PHASES = 3
_ADVICE = (
    "take more photos, a step apart, with two thirds overlap, sharp, of a still scene with texture around plain or "
    "shiny things, at one zoom setting (or say that each photo has its own camera: lens = each)"
)
_SILENT: Callable[[str], None] = lambda sentence: None  # noqa: E731


@dataclass(frozen=True)
class PoseOptions:
    """How structure from motion is run."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are compared: all, or neighbours in name order; `auto` is exhaustive for up to 80 photos."""
    effort: Literal["auto", "quick", "thorough"] = "auto"
    """`thorough` finds and matches more features at about 20 times the cost; `auto` does so where quick is doubtful."""
    lens: Literal["shared", "each"] = "shared"
    """Whether photos of equal size and EXIF (maker, model, focal length) share a camera, or each has its own."""
    max_size_px: int = 1600
    """Larger photos are shrunk to this longest side first."""
    threads: int = 2
    """CPU threads."""
    seed: int = 0
    """For the random choices of matching and mapping."""


def pose_photos(
    photos: Sequence[Path],
    workspace: Path,
    *,
    options: PoseOptions = PoseOptions(),
    progress: Progress = silent,
    say: Callable[[str], None] = _SILENT,
) -> tuple[PosedImages, PoseReport]:
    """Poses, intrinsics and sparse points of `photos`; upright undistorted images are written to `workspace`/images.

    World: +z up, the support plane at z = 0, median camera distance 1 (see `upright`).

    Args:
        photos: At least three, of different names.
        workspace: An existing folder.
        options: How structure from motion is run.
        progress: Moves a bar.
        say: Takes a sentence before a second, longer attempt.

    Returns:
        The photos with a pose, and figures that say how far to trust them (`PoseReport.doubts`).

    Raises:
        ValueError: Where pycolmap is missing, names clash, a photo is unreadable, or under half get a pose.
    """
    if find_spec("pycolmap") is None:
        raise ValueError("photos without poses: expected pycolmap (pip install 'splatgraft[sfm]'), found none")
    if len(photos) < 3:
        raise ValueError(f"{workspace}: expected at least 3 photos to pose, found {len(photos)}")
    efforts = ("quick", "thorough") if options.effort == "auto" else (options.effort,)
    total = _PHASES * len(efforts) + 1
    with tempfile.TemporaryDirectory(prefix=".colmap-", dir=workspace) as scratch:
        progress(0, total, "reading photos")
        copies = working_copies(photos, Path(scratch) / "photos", options.max_size_px)
        models: list[dict[str, Any]] = []
        for attempt, effort in enumerate(efforts):

            def advance(done: int, message: str, before: int = attempt * _PHASES) -> None:
                progress(before + done, total, message)

            models.append(_run(_job(copies, Path(scratch), options, effort), advance))
            doubts = _doubts(models[-1], copies)
            if not doubts:
                break
            if effort != efforts[-1]:
                say(_second_attempt(doubts, models[-1]))
        model = max(models, key=_score)
        registered = {Path(image["name"]).stem for image in model["images"]}
        if len(registered) < 0.5 * len(photos):
            raise ValueError(
                f"{photos[0].parent}: expected at least half of {len(photos)} photos to register, "
                f"found {len(registered)}; {_ADVICE}"
            )
        progress(total - 1, total, "undistorting")
        posed = _posed_images(model, Path(scratch) / "photos", workspace / "images")
        report = PoseReport(
            photos=len(photos),
            registered=len(registered),
            missing=tuple(sorted(photo.stem for photo in photos if photo.stem not in registered)),
            mean_reprojection_px=model["mean_reprojection_px"],
            points=len(posed.points),
            models=model["models"],
            method=model["method"],
            explained=model["explained"],
            lenses=_lenses(model, copies[0].parent),
            doubts=_doubts(model, copies),
        )
    progress(total, total, str(report))
    return posed, report


def _score(model: dict[str, Any]) -> float:
    """As in colmap_process.py, where the number of photos is the same for all."""
    return model["explained"] * len(model["images"])


def _doubts(model: dict[str, Any], copies: Sequence[Path]) -> tuple[Doubt, ...]:
    return find_doubts(
        Found(
            photos=len(copies),
            explained=model["explained"],
            mean_reprojection_px=model["mean_reprojection_px"],
            observations=tuple(image["observations"] for image in model["images"]),
            lenses=_lenses(model, copies[0].parent),
        )
    )


def _lenses(model: dict[str, Any], folder: Path) -> tuple[Lens, ...]:
    groups: dict[int, list[dict[str, Any]]] = {}
    for image in model["images"]:
        groups.setdefault(image["camera_id"], []).append(image)
    return tuple(
        Lens(
            photos=tuple(Path(image["name"]).stem for image in images),
            size=stored_size(folder / images[0]["name"]),
            focal_px=images[0]["camera"][0],
            distortion=images[0]["camera"][3],
        )
        for images in sorted(groups.values(), key=len, reverse=True)
    )


def _second_attempt(doubts: Sequence[Doubt], model: dict[str, Any]) -> str:
    seconds = sum(model["cpu_seconds"].values())
    return (
        f"doubtful after {seconds:.0f} CPU seconds ({'; '.join(str(doubt) for doubt in doubts)}): features, matches "
        f"and mapping once more with more features, which takes about 20 times as long (effort = quick does not)"
    )


def _job(copies: Sequence[Path], scratch: Path, options: PoseOptions, effort: str) -> dict[str, Any]:
    models = scratch / f"models_{effort}"
    models.mkdir()
    return {
        "photos": str(copies[0].parent),
        "database": str(scratch / f"{effort}.db"),
        "models": str(models),
        "output": str(scratch / f"{effort}.json"),
        "thorough": effort == "thorough",
        "groups": camera_groups(copies, shared=options.lens == "shared"),
        "exhaustive": options.matching == "exhaustive" or (options.matching == "auto" and len(copies) <= 80),
        "threads": options.threads,
        "seed": options.seed,
    }


def _run(job: dict[str, Any], advance: Callable[[int, str], None]) -> dict[str, Any]:
    """Raises: ValueError where the process dies, with the last line it wrote."""
    program = Path(__file__).with_name("colmap_process.py")
    log = Path(job["output"]).with_suffix(".log")
    effort = "thorough" if job["thorough"] else "quick"
    command = [sys.executable, str(program), json.dumps(job)]
    with (
        log.open("w") as errors,
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                done, _, message = line.strip().partition(" ")
                if done.isdigit():
                    advance(int(done), f"{message} ({effort})")
            code = process.wait()
        except BaseException:
            process.kill()
            raise
    output = Path(job["output"])
    if code != 0 or not output.is_file():
        last = (log.read_text(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise ValueError(f"{job['photos']}: expected COLMAP to finish, found exit code {code}: {last}")
    return json.loads(output.read_text())


def _posed_images(model: dict[str, Any], photos: Path, folder: Path) -> PosedImages:
    folder.mkdir(exist_ok=True)
    poses, intrinsics, sizes, paths = [], [], [], []
    for image in model["images"]:
        copy, path = photos / image["name"], folder / image["name"]
        f, cx, cy, k = image["camera"]
        size = stored_size(copy)
        matrix = torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=torch.float64)
        distortion = Distortion(matrix, torch.tensor([k, 0, 0, 0, 0], dtype=torch.float64), size)
        intrinsics.append(write_undistorted(copy, path, distortion))
        poses.append([*image["world_from_camera"], [0, 0, 0, 1]])
        sizes.append(size)
        paths.append(path)
    cameras = Cameras(
        world_from_camera=torch.tensor(poses),
        intrinsics=torch.stack(intrinsics),
        sizes=torch.tensor(sizes),
        names=tuple(path.name for path in paths),
    )
    rows = torch.tensor(model["points"]).reshape(-1, 8)
    # a pair of photos makes a point of any false match
    rows = rows[(rows[:, 7] >= 3) & (rows[:, 6] <= 1.5)]
    upright_from_sfm = upright(cameras, rows[:, :3])
    return PosedImages(
        image_paths=tuple(paths),
        cameras=upright_from_sfm.cameras(cameras),
        points=upright_from_sfm.points(rows[:, :3]),
        point_colors=rows[:, 3:6] / 255,
    )
