"""Sample points on meshes inside Blender, uniformly by area."""

import bpy
import numpy as np


def sample_points(things, sampling, seed):
    """Sample positions and outward normals (n, 6), world axes, metres; `sampling` has count, center and radius."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    corners = [
        found for thing in things if thing.type == "MESH" for found in _triangles(thing.evaluated_get(depsgraph))
    ]
    if not corners:
        return np.zeros((0, 6), np.float32)
    triangles = np.concatenate(corners)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    center, radius = np.array(sampling["center"]), sampling["radius"]
    # triangles outside the sphere are excluded
    low, high = triangles.min(1), triangles.max(1)
    near = np.linalg.norm(np.clip(center, low, high) - center, axis=1) < radius
    area = np.linalg.norm(across, axis=1) * near
    if not area.any():
        return np.zeros((0, 6), np.float32)
    rng, found, left = np.random.default_rng(seed), [], sampling["count"]
    for _ in range(60):  # rejection sampling
        chosen = rng.choice(len(area), sampling["count"], p=area / area.sum())
        points = _points_in(rng, triangles[chosen], across[chosen] / area[chosen, None])
        found.append(points[np.linalg.norm(points[:, :3] - center, axis=1) < radius][:left])
        left -= len(found[-1])
        if not left:
            break
    return np.concatenate(found).astype(np.float32)


def _points_in(rng, triangles, normals):
    u, v = rng.random((2, len(triangles), 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    a, b, c = triangles.transpose(1, 0, 2)
    return np.concatenate([a + u * (b - a) + v * (c - a), normals], 1)


def _triangles(thing):
    """Return the corners (t, 3, 3) of an evaluated mesh's triangles in a list, world axes; empty without triangles."""
    mesh = thing.to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", vertices)
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    thing.to_mesh_clear()
    if not len(corners):
        return []
    matrix = np.array(thing.matrix_world)
    world = vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    return [world[corners.reshape(-1, 3)]]
