"""Gaussians on the surface of a triangle mesh, one flat disc for each of many evenly spread points.

1. Find the sides of the surface that can be seen: the outside of closed parts, both sides of open ones.
2. Draw points evenly by area. Keep rows along the edges and a Poisson-disc pattern inside, greedy in random order.
3. Look up normals and material at each point; textures are averaged over the point's share of the surface.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from splatgraft.core.gaussians import KnownSurface
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.meshes import Mesh, Texture, area_vectors, unit
from splatgraft.core.spherical_harmonics import dc_from_rgb

DEFAULT_BUDGET = 60_000
"""Number of Gaussians of a mesh; 1.5 radii away, one of a ball is then 2 pixels wide in a picture of 640."""
_CANDIDATES = 8  # drawn points per kept one
_DENSITY = 0.55  # kept points in a square as wide as their smallest distance, for that many candidates
_WIDTH = 0.7  # standard deviation of a disc over the spacing of the points
_THICKNESS = 0.02  # standard deviation across a disc over the spacing
_OPACITY = 0.99
_INSET = 0.65  # distance of a closed part's discs below the surface, spacings; on it they would overlap silhouettes
_APART = 0.5  # distance of an open part's two sides from the surface, spacings; nearer ones show through each other
_ROW = 1.2  # distance of a row of discs from an edge, spacings; discs of a nearer one would reach beyond the edge
_SHARP = math.cos(math.radians(30))  # cosine of half the angle between the normals of a ridge's sides
_SAME_SIDE = 0.3  # smallest cosine between the normals of two points that exclude each other
_DEGENERATE = 1e-9  # smallest area of a triangle over the square of the mesh's size


def sample_mesh(mesh: Mesh, *, budget: int = DEFAULT_BUDGET, seed: int = 0) -> KnownSurface:
    """Cover a mesh by flat Gaussians.

    Args:
        mesh: At least one triangle.
        budget: Largest number of Gaussians.
        seed: Seed of the points.

    Returns:
        Opaque Gaussians of degree 0 with the mesh's base colour, in the mesh's frame.

    Raises:
        ValueError: The mesh has no area.
    """
    across = area_vectors(mesh.corners)
    area = 0.5 * np.linalg.norm(across, axis=1)
    size = float(np.ptp(mesh.corners.reshape(-1, 3), axis=0).max())
    area[area <= _DEGENERATE * size**2] = 0  # no point is drawn there
    if not area.any():
        raise ValueError("expected triangles with an area, found none")
    triangle, sign, is_open, is_edge = _sides(mesh.corners, size)
    rng = np.random.default_rng(seed)
    total = float(area[triangle].sum())
    which, weights = _drawn(area[triangle], _CANDIDATES * budget, rng)
    facing = unit(across)[triangle] * sign[:, None]
    points, sides = np.einsum("nc,nci->ni", weights, mesh.corners[triangle[which]]), facing[which]
    radius = math.sqrt(_DENSITY * total / budget)
    is_edge &= area[triangle, None] > 0
    order = _inside(points, sides, _edges(mesh.corners[triangle], facing, is_edge, radius), math.sqrt(total / budget))
    which, weights, points, facing = which[order], weights[order], points[order], sides[order]
    kept = _spread(points, facing, radius=radius)[:budget]
    which, weights, points, facing = which[kept], weights[kept], points[kept], facing[kept]
    spacing = math.sqrt(total / len(kept))
    shift = np.where(is_open[which], _APART * spacing, -_insets(points, facing, _INSET * spacing))
    points = points + shift[:, None] * facing
    return _gaussians(mesh, triangle[which], weights, (points, facing, sign[which]), spacing)


def _sides(
    corners: Float[np.ndarray, "t 3 3"], size: float
) -> tuple[Int[np.ndarray, "s"], Float[np.ndarray, "s"], Bool[np.ndarray, "s"], Bool[np.ndarray, "s 3"]]:
    """Find the s sides of triangles that can be seen: the outside of closed parts, both sides of open ones.

    A part is closed if each of its edges is met as often in one direction as in the other. Edge i of a triangle begins
    at corner i. Returns triangles, signs of their normals, whether their part is open, and their ends and sharp ridges.
    """
    grid = np.round(corners.reshape(-1, 3) / (1e-6 * size)).astype(np.int64)
    vertex = np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1, 3)
    begin, end = vertex.ravel(), np.roll(vertex, -1, axis=1).ravel()
    count = int(vertex.max()) + 1
    _, label = connected_components(coo_array((np.ones(len(begin)), (begin, end)), (count, count)), directed=False)
    part = label[vertex[:, 0]]
    edge = np.unique(np.minimum(begin, end) * count + np.maximum(begin, end), return_inverse=True)[1]
    by_edge = csr_array((np.ones(len(edge)), (edge, np.arange(len(edge)))))  # sums values over each edge's triangles
    is_unpaired = (np.asarray(by_edge @ np.sign(end - begin))[edge] != 0).reshape(-1, 3)
    is_open = np.isin(part, part[is_unpaired.any(1)])
    centred = corners - corners.reshape(-1, 3).mean(0)
    volume = np.einsum("ti,ti->t", centred[:, 0], np.cross(centred[:, 1], centred[:, 2]))
    sign = np.where((np.bincount(part, weights=volume)[part] < 0) & ~is_open, -1.0, 1.0)
    middle, normal = (v.repeat(3, axis=0) for v in (centred.mean(1), unit(area_vectors(corners)) * sign[:, None]))
    middles, normals = by_edge @ middle, by_edge @ normal
    # on a ridge each of two triangles lies below the other's plane
    is_ridge = (middles * normals).sum(1) < 2 * (by_edge @ (middle * normal).sum(1))
    is_sharp = np.linalg.norm(normals, axis=1) < _SHARP * by_edge.sum(1)
    is_edge = is_unpaired | (is_ridge & is_sharp)[edge].reshape(-1, 3)
    triangle = np.concatenate([np.arange(len(corners)), is_open.nonzero()[0]])
    return triangle, np.append(sign, np.full(is_open.sum(), -1.0)), is_open[triangle], is_edge[triangle]


def _insets(
    points: Float[np.ndarray, "n 3"], facing: Float[np.ndarray, "n 3"], largest: float
) -> Float[np.ndarray, "n"]:
    """Compute the largest inward shift of each point: `largest`, or 0.4 of the thickness of a thin part."""
    out = np.full(len(points), largest)
    pairs = KDTree(points).query_pairs(2.5 * largest, output_type="ndarray")
    pairs = pairs[np.einsum("pi,pi->p", facing[pairs[:, 0]], facing[pairs[:, 1]]) < -_SAME_SIDE]
    for one, other in (pairs.T, pairs[:, ::-1].T):
        depth = np.einsum("pi,pi->p", points[one] - points[other], facing[one])
        np.minimum.at(out, one, np.where(depth > 0, 0.4 * depth, largest))
    return out


def _drawn(
    area: Float[np.ndarray, "t"], count: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "c"], Float[np.ndarray, "c 3"]]:
    """Draw triangles and barycentric coordinates evenly by area, in random order."""
    filled = np.cumsum(area)
    at = (rng.permutation(count) + rng.random(count)) / count * filled[-1]
    which = np.minimum(np.searchsorted(filled, at, side="right"), len(area) - 1)
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    return which, np.stack([1 - root, root * (1 - v), root * v], 1)


def _edges(
    corners: Float[np.ndarray, "s 3 3"], facing: Float[np.ndarray, "s 3"], is_edge: Bool[np.ndarray, "s 3"], step: float
) -> tuple[Float[np.ndarray, "e 3"], Float[np.ndarray, "e 3"], Float[np.ndarray, "e 3"]]:
    """Place points along edges, at most `step` apart; returns them, unit vectors into the surface, and its normals."""
    side, edge = is_edge.nonzero()
    begin, along = corners[side, edge], corners[side, (edge + 1) % 3] - corners[side, edge]
    inward = np.cross(facing[side], along)
    inward *= np.sign((inward * (corners[side, (edge + 2) % 3] - begin)).sum(1, keepdims=True))
    counts = np.ceil(np.linalg.norm(along, axis=1) / step).astype(int)
    row = np.arange(len(side)).repeat(counts)
    share = (np.arange(len(row)) - (counts.cumsum() - counts)[row] + 0.5) / counts[row]
    return begin[row] + share[:, None] * along[row], unit(inward)[row], facing[side][row]


def _inside(
    points: Float[np.ndarray, "c 3"],
    facing: Float[np.ndarray, "c 3"],
    edges: tuple[Float[np.ndarray, "e 3"], Float[np.ndarray, "e 3"], Float[np.ndarray, "e 3"]],
    spacing: float,
) -> Int[np.ndarray, "k"]:
    """Choose points that are not too near to an edge of their side; those in a row along it come first."""
    on_edge, inward, edge_facing = edges
    if not len(on_edge):
        return np.arange(len(points))
    distance = _ROW * spacing
    # the normals as further coordinates keep sides apart
    here, there = (np.hstack([p, distance * n]) for p, n in ((points, facing), (on_edge, edge_facing)))
    rows = KDTree(here).query(np.hstack([on_edge + distance * inward, distance * edge_facing]))[1]
    away = KDTree(there).query(here, distance_upper_bound=distance)[0]
    return np.append(list(dict.fromkeys(np.atleast_1d(rows).tolist())), (away >= distance).nonzero()[0])


def _spread(points: Float[np.ndarray, "c 3"], facing: Float[np.ndarray, "c 3"], *, radius: float) -> np.ndarray:
    """Choose points in their order, without those that lie within a radius of a chosen one of the same side."""
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.einsum("pi,pi->p", facing[pairs[:, 0]], facing[pairs[:, 1]]) > _SAME_SIDE]
    # query_pairs lists the earlier point first
    is_kept, is_left = np.zeros(len(points), bool), np.ones(len(points), bool)
    while is_left.any():
        chosen = is_left.copy()
        chosen[pairs[:, 1]] = False
        is_kept |= chosen
        is_left &= ~chosen
        is_left[pairs[chosen[pairs[:, 0]], 1]] = False
        pairs = pairs[is_left[pairs].all(1)]
    return is_kept.nonzero()[0]


def _gaussians(
    mesh: Mesh,
    triangle: Int[np.ndarray, "n"],
    weights: Float[np.ndarray, "n 3"],
    placed: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]],
    spacing: float,
) -> KnownSurface:
    points, facing, sign = placed
    n = len(points)
    normals, uv, colors = (
        np.einsum("nc,nci->ni", weights, values[triangle]) for values in (mesh.normals, mesh.uv, mesh.colors)
    )
    normals = unit(normals) * np.where((normals * facing).sum(1) < 0, -1, 1)[:, None]
    rgba = np.concatenate([colors, np.ones((n, 1))], 1)
    metallic, roughness, emission, is_there = np.empty(n), np.empty(n), np.empty((n, 3)), np.empty(n, bool)
    corners, uv_corners = mesh.corners[triangle], mesh.uv[triangle].astype(np.float64)
    edges, uv_edges = corners[:, 1:] - corners[:, :1], uv_corners[:, 1:] - uv_corners[:, :1]
    uv_per_area = np.abs(np.linalg.det(uv_edges)) / np.linalg.norm(area_vectors(corners), axis=1)
    footprint = uv_per_area * spacing**2
    for index, material in enumerate(mesh.materials):
        here = mesh.material[triangle] == index
        at = uv[here], footprint[here]
        rgba[here] *= material.color * _looked_up(material.color_map, *at, is_srgb=True)
        is_there[here] = rgba[here, 3] >= material.alpha_cutoff
        surface = _looked_up(material.surface_map, *at)
        metallic[here], roughness[here] = material.metallic * surface[:, 2], material.roughness * surface[:, 1]
        emission[here] = material.emission * _looked_up(material.emission_map, *at, is_srgb=True)[:, :3]
        if material.normal_map is not None:
            bent = 2 * _looked_up(material.normal_map, *at)[:, :3] - 1
            bent[:, :2] *= material.normal_scale
            normals[here] = _bent(normals[here], bent, edges[here], uv_edges[here], sign[here])
    rotation = np.stack([1 + facing[:, 2], -facing[:, 1], facing[:, 0], np.zeros(n)], 1)
    rotation[facing[:, 2] < -0.999999] = (0, 1, 0, 0)
    log_scales = np.full((n, 3), np.log(spacing * np.array([_WIDTH, _WIDTH, _THICKNESS])))
    fields = (points, log_scales, unit(rotation), normals, metallic.clip(0, 1), roughness.clip(0, 1), emission)
    means, scales, quaternions, *known = (torch.tensor(values, dtype=torch.float32) for values in fields)
    sh = dc_from_rgb(srgb_from_linear(torch.tensor(rgba[:, :3].clip(0, 1), dtype=torch.float32)))[:, None]
    surface = KnownSurface(means, scales, quaternions, torch.full((n,), _OPACITY).logit(), sh, *known)
    return surface.select(torch.from_numpy(is_there))


def _bent(
    normals: Float[np.ndarray, "n 3"],
    bent: Float[np.ndarray, "n 3"],
    edges: Float[np.ndarray, "n 2 3"],
    uv_edges: Float[np.ndarray, "n 2 2"],
    sign: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 3"]:
    """Turn normals by a normal map's values, whose axes are along u, against v, and outwards."""
    turn = np.sign(np.linalg.det(uv_edges))[:, None]
    along = turn * (uv_edges[:, 1, 1:] * edges[:, 0] - uv_edges[:, 0, 1:] * edges[:, 1])
    against = turn * (uv_edges[:, 1, :1] * edges[:, 0] - uv_edges[:, 0, :1] * edges[:, 1])
    tangent, bitangent = (unit(axis - (axis * normals).sum(1)[:, None] * normals) for axis in (along, against))
    # on the back of a sheet the same relief is seen from behind
    lifted = sign[:, None] * (bent[:, :1] * tangent + bent[:, 1:2] * bitangent)
    return unit(lifted + np.maximum(bent[:, 2:], 0.1) * normals)


def _looked_up(
    texture: Texture | None, uv: Float[np.ndarray, "n 2"], footprint: Float[np.ndarray, "n"], *, is_srgb: bool = False
) -> Float[np.ndarray, "n 4"]:
    """Average a texture over an area of uv around each point; linear values in [0, 1], 1 for None.

    With `is_srgb`, the colours are decoded; alpha is linear.
    """
    if texture is None:
        return np.ones((len(uv), 4))
    matrix = texture.image_from_uv
    at = uv @ matrix[:, :2].T + matrix[:, 2]
    for axis, wrap in enumerate(texture.wrap):
        values = at[:, axis]
        at[:, axis] = {"repeat": values % 1, "mirror": 1 - np.abs(values % 2 - 1), "clamp": values.clip(0, 1)}[wrap]
    image = torch.from_numpy(texture.pixels.astype(np.float32) / 255)
    if is_srgb:
        image[..., :3] = linear_from_srgb(image[..., :3])
    levels = [image.permute(2, 0, 1)[None]]
    texels = footprint * abs(np.linalg.det(matrix[:, :2])) * image.shape[0] * image.shape[1]
    level = (0.5 * np.log2(np.maximum(texels, 1))).astype(int)
    while len(levels) <= level.max(initial=0) and min(levels[-1].shape[2:]) > 1:
        levels.append(F.interpolate(levels[-1], scale_factor=0.5, mode="area"))
    grid = torch.from_numpy(2 * at - 1).float()[None, None]  # -1 and 1 are the image's borders
    found = [F.grid_sample(one, grid, padding_mode="border", align_corners=False)[0, :, 0] for one in levels]
    return torch.stack(found).numpy()[level.clip(max=len(levels) - 1), :, np.arange(len(uv))]
