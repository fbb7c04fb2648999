"""Points of a scene's surface that a picture shows, from the rendered depth."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering.interface import render


def surface_points(scene: Gaussians, camera: Cameras, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """The points of the scene's surface that a picture shows at `pixels`; those that show nothing are left out.

    Args:
        scene: What is seen.
        camera: One camera.
        pixels: x and y, pixels of the camera's picture.
    """
    drawn = render(scene, camera, outputs=frozenset({"depth"}))
    pixels = pixels.to(drawn.depth)
    size = camera.sizes[0].to(pixels)
    pixels = torch.minimum(pixels.clamp_min(0), size - 1)
    column, row = pixels.long().unbind(-1)
    solid = drawn.alpha[0][row, column] > 0.5
    depth = drawn.depth[0][row, column]
    rays = torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1) @ torch.linalg.inv(camera.intrinsics[0].to(pixels)).T
    pose = camera.world_from_camera[0].to(pixels)
    return ((rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3])[solid].detach()
