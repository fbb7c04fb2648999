"""The first selection of an object's Gaussians: what stands in its region, or what belongs to points of a user.

Points that a user gave are moved to the surface by the rendered depth. Each Gaussian of the region then belongs to the
side, object or surroundings, from which it is reached over the shorter way, where a way over a change of colour is
longer (geodesic segmentation; Bai and Sapiro 2007, here on the graph of neighbouring Gaussians).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.prompts import ViewPrompt
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.rendering import surface_points
from splatgraft.segmentation.box import Box
from splatgraft.segmentation.object_region import ObjectRegion, guess_region, region_of_box


@dataclass(frozen=True)
class SeedOptions:
    """Which Gaussians count, and what a change of colour costs; values set by hand."""

    least_opacity: float = 0.3
    """Of a Gaussian that is a surface point."""
    color_step: float = 2.0
    """Difference of colour at which a way is twice as long, over the median one of neighbours: texture and noise."""
    neighbours: int = 10
    """Nearest Gaussians to which a way leads."""
    touched: int = 6
    """Gaussians nearest to a point that the user gave which have its side for certain."""


@dataclass(frozen=True)
class Seed:
    """The first selection, and where it was looked for."""

    selection: Bool[Tensor, "n"]
    """Which Gaussians are likely the object's."""
    region: ObjectRegion
    """Where they were looked for."""


def seed_selection(
    scene: Gaussians,
    cameras: Cameras,
    *,
    box: Box | None = None,
    prompts: Mapping[int, ViewPrompt] | None = None,
    known: Bool[Tensor, "n"] | None = None,
    options: SeedOptions = SeedOptions(),
) -> Seed:
    """Select what is likely the object.

    Args:
        scene: n Gaussians.
        cameras: Of the capture, on the device of `scene`.
        box: Around the object, world units; guessed where None.
        prompts: What the user says, by index of the camera, pixels of its picture.
        known: Gaussians that masks of some pictures give to the object; None where there are no masks.
        options: What counts.

    Raises:
        ValueError: Where nothing tells where the object is, or nothing is there.
    """
    prompts = prompts or {}
    opaque = scene.opacities > options.least_opacity
    inside, outside = (_points_on_surface(scene, cameras, prompts, which) for which in ("inside", "outside"))
    framed = _framed(scene.means, cameras, prompts)
    if box is not None:
        region = region_of_box(cameras, scene.means[opaque], box)
    else:
        pointed_at = inside if len(inside) else None
        if known is not None and bool((known & opaque).any()):
            pointed_at = torch.cat([inside, scene.means[known & opaque]])
        region = guess_region(cameras, scene.means[opaque & framed], pointed_at=pointed_at)
    selection = region.contains(scene.means) & framed
    if known is not None:
        selection = selection & known
    if len(inside) and any(len(prompt.inside) for prompt in prompts.values()):
        selection = selection & _nearer_inside(scene, region, inside, outside=outside, options=options)
    if not bool((selection & opaque).any()):
        raise ValueError(
            f"object: expected something solid in {region.reason}, found nothing; give its --box, or --prompts with "
            "clicks in two or three pictures"
        )
    return Seed(selection, region)


def _points_on_surface(
    scene: Gaussians, cameras: Cameras, prompts: Mapping[int, ViewPrompt], which: str
) -> Float[Tensor, "k 3"]:
    """The points `inside` or `outside` on the surface that their picture shows; a rectangle alone gives its centre."""
    found = [torch.zeros(0, 3, device=scene.device)]
    for index, prompt in prompts.items():
        pixels = prompt.inside if which == "inside" else prompt.outside
        if which == "inside" and not len(pixels) and prompt.box is not None:
            left, top, right, bottom = prompt.box
            pixels = torch.tensor([[(left + right) / 2, (top + bottom) / 2]])
        if len(pixels):
            found.append(surface_points(scene, cameras[index], pixels))
    return torch.cat(found)


def _framed(points: Float[Tensor, "n 3"], cameras: Cameras, prompts: Mapping[int, ViewPrompt]) -> Bool[Tensor, "n"]:
    """Which points lie in the user's rectangle in every picture that has one."""
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for index, prompt in prompts.items():
        if prompt.box is not None:
            camera = cameras[index]
            pose = camera.camera_from_world[0].to(points)
            local = points @ pose[:3, :3].T + pose[:3, 3]
            pixels = (local @ camera.intrinsics[0].to(points).T)[:, :2] / local[:, 2:].clamp_min(1e-9)
            corners = torch.tensor(prompt.box).to(points)
            inside &= ((pixels >= corners[:2]) & (pixels <= corners[2:])).all(1) & (local[:, 2] > 0)
    return inside


def _nearer_inside(
    scene: Gaussians,
    region: ObjectRegion,
    inside: Float[Tensor, "k 3"],
    *,
    outside: Float[Tensor, "m 3"],
    options: SeedOptions,
) -> Bool[Tensor, "n"]:
    """Which Gaussians are nearer to the points on the object than to those beside it and to the region's outside."""
    around = torch.nonzero(region.box.grown(1.5).contains(scene.means)).flatten()
    near = scene.select(around)
    means = near.means.detach().double().cpu().numpy()
    if len(means) <= options.neighbours:
        return torch.ones(scene.count, dtype=torch.bool, device=scene.device)
    tree = KDTree(means)
    distance, neighbour = tree.query(means, k=options.neighbours + 1)
    colors = rgb_from_dc(near.sh[:, 0]).detach().double().cpu().numpy()
    change = np.linalg.norm(colors[:, None] - colors[neighbour], axis=-1)
    step = options.color_step * max(float(np.median(change[:, 1:])), 1e-3)
    cost = distance * (1 + change / step) + 1e-12
    rows = np.broadcast_to(np.arange(len(means))[:, None], cost.shape)
    graph = coo_array((cost.ravel(), (rows.ravel(), np.asarray(neighbour).ravel())), shape=(len(means),) * 2).tocsr()

    def touched(points: Tensor) -> np.ndarray:
        return np.unique(np.asarray(tree.query(points.cpu().numpy(), k=options.touched)[1])) if len(points) else _NONE

    beyond = np.flatnonzero(~region.contains(near.means).cpu().numpy())
    ways = [
        dijkstra(graph, directed=False, indices=sources, min_only=True) if len(sources) else np.full(len(means), np.inf)
        for sources in (touched(inside), np.union1d(touched(outside), beyond))
    ]
    chosen = torch.zeros(scene.count, dtype=torch.bool, device=scene.device)
    chosen[around] = torch.from_numpy(ways[0] <= ways[1]).to(scene.device) & torch.from_numpy(np.isfinite(ways[0])).to(
        scene.device
    )
    return chosen


_NONE = np.zeros(0, np.int64)
