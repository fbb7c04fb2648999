"""Pictures of a scene's surface from a depth map: inverse depth in colours, and normals in colours.

Normals are central differences of the pixels' points in the camera frame, after a median filter of inverse depth.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from splatgraft.core.cameras import Cameras

_FAR_TO_NEAR = torch.tensor(
    [
        [0.267, 0.005, 0.329],
        [0.279, 0.175, 0.483],
        [0.230, 0.322, 0.546],
        [0.173, 0.449, 0.558],
        [0.128, 0.567, 0.551],
        [0.158, 0.684, 0.502],
        [0.369, 0.789, 0.383],
        [0.678, 0.864, 0.190],
        [0.993, 0.906, 0.144],
    ]
)  # sRGB; every 32nd colour of viridis (van der Walt and Smith, CC0), whose lightness rises evenly
_FAR_QUANTILE, _NEAR_QUANTILE = 0.02, 0.98  # of inverse depth; pixels beyond them get the end colours
_MEDIAN_PX = 5  # window; neighbouring pixels see planes of different Gaussians, whose depths differ a little
_STEP = 0.05  # share of the inverse depth; a surface that bends by more between pixels counts as two; set by hand
_OPENGL_FROM_OPENCV = torch.tensor([1.0, -1.0, -1.0])  # y and z of the camera frame change their signs


def depth_colors(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Colour a depth map by inverse depth, from violet (far) over green to yellow (near).

    Args:
        depth: Distance along the optical axis, any unit; 0 where there is no surface.

    Returns:
        sRGB in [0, 1]; black where there is no surface.
    """
    solid = depth > 0
    if not bool(solid.any()):
        return depth.new_zeros(*depth.shape, 3)
    inverse = inverse_depth(depth)
    far, near = np.quantile(inverse[solid].cpu().numpy(), (_FAR_QUANTILE, _NEAR_QUANTILE)).tolist()
    share = ((inverse - far) / max(near - far, np.finfo(np.float32).tiny)).clamp(0, 1)
    table = _FAR_TO_NEAR.to(depth)
    place = share * (len(table) - 1)
    below = place.long().clamp_max(len(table) - 2)
    colors = torch.lerp(table[below], table[below + 1], (place - below)[..., None])
    return torch.where(solid[..., None], colors, 0.0)


def normals_from_depth(depth: Float[Tensor, "h w"], camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Compute the normal of the surface in each pixel by central differences of its neighbours' points.

    Args:
        depth: Distance along the optical axis, on the CPU; 0 where there is no surface.
        camera: The camera of the depth map.

    Returns:
        Unit normals in the camera frame with OpenGL axes (x right, y up, z towards the viewer), on the visible side;
        0 where a pixel or one of its four neighbours has no surface, or where there is a depth step between them.
        The outermost pixels repeat the values beside them.
    """
    inverse = torch.where(depth > 0, _median(inverse_depth(depth)), 0.0)
    normals = normals_by_differences(inverse, camera.to("cpu")) * _OPENGL_FROM_OPENCV
    normals = torch.where(_one_surface(inverse)[..., None], normals, 0.0)
    padded = F.pad(normals.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    return torch.where((inverse > 0)[..., None], padded, 0.0)


def normals_by_differences(inverse: Float[Tensor, "h w"], camera: Cameras) -> Float[Tensor, "h-2 w-2 3"]:
    """Compute unit normals towards the camera, OpenCV axes, by central differences of the points of inner pixels.

    `inverse` is inverse depth along the optical axis; normals beside a pixel of 0, without a surface, are undefined.
    """
    rays = camera.rays()
    points = rays * inverse_depth(inverse)[..., None]
    along_u = points[1:-1, 2:] - points[1:-1, :-2]
    along_v = points[2:, 1:-1] - points[:-2, 1:-1]
    normals = F.normalize(torch.linalg.cross(along_u, along_v), dim=-1)
    away = (normals * rays[1:-1, 1:-1]).sum(-1, keepdim=True) > 0
    return torch.where(away, -normals, normals)


def inverse_depth(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Invert a depth map, or an inverse one; 0, which means no surface, stays 0."""
    return torch.where(depth > 0, 1 / torch.where(depth > 0, depth, 1), 0)


def normal_colors(normals: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Colour unit normals as 0.5 + 0.5 n; black where they are 0."""
    return torch.where((normals != 0).any(-1, keepdim=True), 0.5 + 0.5 * normals, 0.0)


def _one_surface(inverse: Float[Tensor, "h w"]) -> Bool[Tensor, "h-2 w-2"]:
    """Find the inner pixels without a depth step to their neighbours."""
    # the inverse depth of a plane is linear in the image, however much the plane recedes
    middle, right, left = inverse[1:-1, 1:-1], inverse[1:-1, 2:], inverse[1:-1, :-2]
    below, above = inverse[2:, 1:-1], inverse[:-2, 1:-1]
    bend = torch.maximum((right + left - 2 * middle).abs(), (below + above - 2 * middle).abs())
    solid = torch.stack([middle, right, left, below, above]).amin(0) > 0
    return solid & (bend <= _STEP * middle)


def _median(inverse: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Take the median of each pixel's window, which keeps planes and edges."""
    return torch.from_numpy(cv2.medianBlur(inverse.contiguous().numpy(), _MEDIAN_PX))
