"""Measures the surface errors of reconstructions on rendered scenes with known depth.

    python benchmarks/geometry.py FOLDER [FOLDER ...] [--bare FOLDER] --out build/geometry/geometry.json
    python benchmarks/geometry.py --render-bare FOLDER --blender-python PYTHON

FOLDER has scenes/ and renders/, as `splatgraft paper exam` writes them. Each scene's target is reconstructed again,
without the held-out views, and measured in all views: near the place of the object, and everywhere. The second command
renders rooms with a bare table (`bare_tables.py`), where `near` is the table's top. The folder named like the JSON file
has a picture of each scene, with one row for each quality: photo, true depth, rendered depth and its normals.
"""

import argparse
import json
import math
import shlex
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from bare_tables import TABLES, is_table_top, render_bare
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import read_mask, write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.evaluation import depth_colors, normal_colors, normals_from_depth
from splatgraft.evaluation.geometry_pictures import inverse_depth, normals_by_differences
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render
from splatgraft.runtime.process import source_commit
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE

_OFF = 0.05  # relative error of the depth from which a pixel counts as off
_NEAR_PX = 21  # around the object's mask, along rows and columns
_SMOOTHED_PX = 5  # width of the box in which inverse depth is averaged before it is differenced
_NO_NORMAL_DEG = 90.0  # error of the normal of a pixel that shows no surface
_WARM_UP_STEPS = 2  # they load the kernels, whose time is not the reconstruction's


@dataclass(frozen=True)
class TrueScene:
    """A capture with the true depth of its v views."""

    name: str
    capture: PosedImages
    depths: tuple[Float[Tensor, "h w"], ...]
    """Along the optical axis, world units; 0 where there is sky."""
    near: tuple[Bool[Tensor, "h w"], ...]
    """Pixels near the place of the object without its own, or the top of a bare table."""
    is_bare: bool = False
    """Whether it is a bare table."""


@dataclass(frozen=True)
class Row:
    """One reconstruction, measured in all views; shares and medians are over the pixels of all views."""

    scene: str
    quality: str
    is_bare: bool
    near_off: float
    """Share of the pixels near the object whose depth is off by more than 5% or that show no surface."""
    near_error: float
    """Median relative error of their depth."""
    all_off: float
    """Share of all pixels that are not sky."""
    all_error: float
    """Median relative error of their depth."""
    near_normal_deg: float
    """Median angle between normals from rendered and from true depth near the object."""
    psnr_held_out: float
    """Mean over the held-out views, dB."""
    psnr_fitted: float
    """Mean over the other views, dB."""
    cpu_seconds: float
    """Of the reconstruction, all threads."""
    gaussians: int
    """Number of them."""


_COLUMNS = {
    "near_off": ("off near, %", 100, 1),
    "near_error": ("median near, %", 100, 2),
    "all_off": ("off, %", 100, 1),
    "all_error": ("median, %", 100, 2),
    "near_normal_deg": ("normals near, degrees", 1, 1),
    "psnr_held_out": ("held out, dB", 1, 2),
    "psnr_fitted": ("fitted, dB", 1, 2),
    "cpu_seconds": ("CPU s", 1, 0),
    "gaussians": ("Gaussians", 1, 0),
}
"""Columns of the table by field of `Row`: title, factor on the value, decimals."""


def depth_error(rendered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Relative error of the depth; 1 where no surface is rendered (depth 0), not a number in the sky."""
    return (rendered - truth).abs() / truth


def _neighbourhood(known: Bool[Tensor, "h w"], width: int) -> Float[Tensor, "h w"]:
    """Share of a box of pixels that is known; there is none outside of the image."""
    return functional.avg_pool2d(known.float()[None], width, 1, width // 2)[0]


def normals_of_depth(depth: Float[Tensor, "h w"], camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Compute unit normals towards the camera, in its axes; 0 where depth is unknown.

    A float16 depth has steps of up to a thousandth, often more than its change from pixel to pixel. So inverse depth,
    which is linear in the pixels of a plane, is averaged in a box first, in rendered and in true depth; unknown pixels
    are left out. The true depth of a bare table then gives its normal to 0.4 degrees in the median.
    """
    known = depth > 0
    share = _neighbourhood(known, _SMOOTHED_PX)
    inverse = functional.avg_pool2d(inverse_depth(depth)[None], _SMOOTHED_PX, 1, _SMOOTHED_PX // 2)[0]
    normals = normals_by_differences(inverse / share.clamp_min(1e-6), camera)
    return functional.pad(normals, (0, 0, 1, 1, 1, 1)) * known[..., None]


def normal_error_deg(
    rendered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"], camera: Cameras
) -> Float[Tensor, "h w"]:
    """Angle between the normals of two depth maps; 90 where no surface is rendered.

    It is not a number where the true normal is unknown: the true depth has to be known in all pixels that it uses.
    """
    cosine = (normals_of_depth(rendered, camera) * normals_of_depth(truth, camera)).sum(-1).clamp(-1, 1)
    angle = torch.where(rendered > 0, cosine.arccos().rad2deg(), _NO_NORMAL_DEG)
    has_normal = _neighbourhood(truth > 0, _SMOOTHED_PX + 2) > 1 - 1e-4
    return torch.where(has_normal, angle, torch.nan)


def exam_scenes(folder: Path) -> Iterator[TrueScene]:
    """Read the scenes of a folder that are rendered to the end."""
    for path in sorted(path for path in (folder / "scenes").iterdir() if (path / TRUE_LIGHT_FILE).is_file()):
        rendered = folder / "renders" / f"{path.name}_target"
        capture = read_capture(path / "target")
        depths, near = [], []
        for name in capture.cameras.names:
            depths.append(_read_depth(rendered / "target" / f"{Path(name).stem}_depth.npy"))
            mask = (read_mask(rendered / "ground_truth" / f"{Path(name).stem}_mask.png") > 0.5).float()
            around = functional.max_pool2d(mask[None], 2 * _NEAR_PX + 1, 1, _NEAR_PX)[0]
            near.append((around > 0) & (mask == 0) & (depths[-1] > 0))
        yield TrueScene(f"{folder.resolve().name}-{path.name}", capture, tuple(depths), tuple(near))


def bare_scenes(folder: Path) -> Iterator[TrueScene]:
    """Read the bare tables that `render_bare` has rendered."""
    for name in TABLES:
        if not (folder / name / "points.ply").is_file():
            continue
        capture = read_capture(folder / name)
        depths = tuple(_read_depth(folder / name / "depth" / f"{Path(n).stem}.npy") for n in capture.cameras.names)
        near = []
        for camera, depth in zip(capture.cameras, depths, strict=True):
            pose = camera.world_from_camera[0]
            near.append(is_table_top((camera.rays() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]) & (depth > 0))
        yield TrueScene(f"bare-{name}", capture, depths, tuple(near), is_bare=True)


def _read_depth(path: Path) -> Float[Tensor, "h w"]:
    return torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32))


@torch.no_grad()
def _drawn(scene: Gaussians, camera: Cameras) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """The colour, and the depth, which is 0 where no surface is seen."""
    found = render(scene, camera, outputs=frozenset({"color", "depth"}))
    return found.color[0].clamp(0, 1), found.depth[0]


def measure(case: TrueScene, options: ReconstructOptions) -> tuple[Row, Gaussians]:
    """Reconstruct a scene without the held-out views and measure it in all views."""
    is_held_out = held_out(len(case.capture), HELD_OUT_EVERY)
    begin = time.process_time()
    scene = reconstruct(case.capture.select(~is_held_out), options)
    seconds = time.process_time() - begin
    near_errors, all_errors, angles, quality = [], [], [], []
    for i, camera in enumerate(case.capture.cameras):
        color, depth = _drawn(scene, camera)
        errors = depth_error(depth, case.depths[i])
        near_errors.append(errors[case.near[i]])
        all_errors.append(errors[case.depths[i] > 0])
        angle = normal_error_deg(depth, case.depths[i], camera)
        angles.append(angle[case.near[i] & ~angle.isnan()])
        quality.append(psnr(color, case.capture.image(i)))
    near, everywhere, decibels = torch.cat(near_errors), torch.cat(all_errors), torch.stack(quality)
    row = Row(
        scene=case.name,
        quality=options.quality,
        is_bare=case.is_bare,
        near_off=float((near > _OFF).float().mean()),
        near_error=float(near.median()),
        all_off=float((everywhere > _OFF).float().mean()),
        all_error=float(everywhere.median()),
        near_normal_deg=float(torch.cat(angles).median()),
        psnr_held_out=float(decibels[is_held_out].mean()),
        psnr_fitted=float(decibels[~is_held_out].mean()),
        cpu_seconds=seconds,
        gaussians=scene.count,
    )
    return row, scene


def picture(case: TrueScene, scene: Gaussians) -> Float[Tensor, "h w 3"]:
    """Photo, true depth, rendered depth and its normals, of the view with most pixels near the object."""
    index = int(torch.stack([near.sum() for near in case.near]).argmax())
    camera, truth = case.capture.cameras[index], case.depths[index]
    depth = _drawn(scene, camera)[1]
    # coloured together, so that both maps have one scale
    colors = depth_colors(torch.cat([truth, depth], 1))
    return torch.cat([case.capture.image(index), colors, normal_colors(normals_from_depth(depth, camera))], 1)


def table(rows: list[Row], quality: str) -> str:
    """One block of the report: a line for each scene, and the means of both kinds of scenes."""
    head = ["scene", *(title for title, _, _ in _COLUMNS.values())]
    lines = [f"### {quality}", "", "| " + " | ".join(head) + " |", "| --- |" + " ---: |" * len(_COLUMNS)]

    def line(name: str, shown: list[Row]) -> str:
        cells = []
        for column, (_, factor, decimals) in _COLUMNS.items():
            mean = math.fsum(getattr(row, column) for row in shown) / len(shown)
            cells.append(f"{mean * factor:.{decimals}f}")
        return f"| {name} | " + " | ".join(cells) + " |"

    for is_bare in (False, True):
        chosen = [row for row in rows if row.quality == quality and row.is_bare == is_bare]
        lines += [line(row.scene, [row]) for row in chosen]
        if chosen:
            lines.append(line(f"**mean, {'bare tables' if is_bare else 'scenes'}: {len(chosen)}**", chosen))
    return "\n".join(lines) + "\n"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", help="folders of scenes/ and renders/ of an exam")
    parser.add_argument("--names", nargs="+", default=[""], help="parts of names; only such scenes are measured")
    parser.add_argument("--qualities", nargs="+", default=["draft", "standard"], help="of the reconstruction")
    parser.add_argument("--bare", type=Path, help="folder of rendered bare tables")
    parser.add_argument("--iterations", type=int, default=1000, help="steps of each reconstruction")
    parser.add_argument("--budget", type=int, default=20_000, help="Gaussians of each reconstruction")
    parser.add_argument("--out", type=Path, default=Path("build/geometry/geometry.json"), help="all rows, as JSON")
    parser.add_argument("--render-bare", type=Path, help="folder into which the bare tables are rendered")
    parser.add_argument("--blender-python", type=Path, default=Path(sys.executable), help="a Python with bpy")
    return parser.parse_args()


def main() -> None:
    """Render, or measure and print."""
    options = _arguments()
    if options.render_bare:
        render_bare(options.render_bare, options.blender_python.absolute())
    head = {"command": shlex.join(["benchmarks/geometry.py", *sys.argv[1:]]), "commit": source_commit()}
    rows: list[Row] = []
    cases = [case for folder in options.scenes for case in exam_scenes(folder)]
    cases += bare_scenes(options.bare) if options.bare else []
    cases = [case for case in cases if any(part in case.name for part in options.names)]
    for quality in options.qualities if cases else ():
        reconstruct(cases[0].capture, ReconstructOptions(quality, iterations=_WARM_UP_STEPS, budget=options.budget))
    for case in cases:
        pictures = []
        for quality in options.qualities:
            how = ReconstructOptions(quality=quality, iterations=options.iterations, budget=options.budget)
            row, scene = measure(case, how)
            rows.append(row)
            pictures.append(picture(case, scene))
            print(f"{case.name} {quality}: {row.near_off:.1%} off near, {row.all_off:.1%} off", flush=True)
        folder = options.out.with_suffix("")
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder / f"{case.name}.png", torch.cat(pictures))
        # saved after each scene: a stopped run keeps its rows
        options.out.write_text(json.dumps({**head, "rows": [asdict(row) for row in rows]}, indent=1), encoding="utf-8")
    if rows:
        blocks = [table(rows, quality) for quality in options.qualities]
        print("\n" + "\n".join(blocks) + f"\n`{head['command']}` at commit {head['commit']}")


if __name__ == "__main__":
    main()
