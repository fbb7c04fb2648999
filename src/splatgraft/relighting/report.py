"""What a transfer shows beside its result: pictures of the estimated lights, and a check of their level.

The check compares the estimated change of illuminance with that of the photos' luminance: exposure metadata gives both
captures absolute units. The ratio that is applied to the object is in each capture's own units, whatever it says.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents
from splatgraft.core.exposure import LuminanceScale
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import LUMINANCE, srgb_from_linear
from splatgraft.relighting.layers import Relit
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.light import LightSource
from splatgraft.relighting.light.panorama import cube_pixels, nearest_directions, render_panorama
from splatgraft.runtime.note import Note

# when a level is doubtful; set by hand
_MAX_DIFFERENCE = 1.5
"""Stops. The mean reflectance of what a capture shows is mostly from 0.1 to 0.5: of two, at most about 2.3 stops apart,
and seldom more than this."""
_MAX_LUX = 200_000.0  # sun and clear sky give up to 130,000; the rest is the error of cameras' speeds

# pictures
_HEIGHT = 256  # pixels of the panorama, which is twice as wide
_FACE = 128  # pixels; width of a face of the cube map that is drawn
_UNSEEN = torch.tensor([0.35, 0.35, 0.38])  # sRGB that directions without a photograph are mixed with
_STOPS = 2.0
"""Residual, in stops, of full colour: red where a surface is brighter than explained, blue where it is darker."""
_RED, _WHITE, _BLUE = torch.tensor([[0.8, 0.1, 0.1], [0.92, 0.92, 0.92], [0.1, 0.25, 0.8]])


def describe_level(relit: Relit, *, target: LuminanceScale, source: LuminanceScale) -> tuple[Note, ...]:
    """Compare how much brighter the new place is by the photos and by the light on each object, before any share.

    Args:
        relit: A transfer.
        target: Of the target's photos.
        source: Of the photos that all objects of known source light come from.

    Returns:
        A note per object of known source light, a warning where the two do not agree or where there is more light than
        under the sun; none where a photo shows no light.
    """
    if min(target.mean, source.mean) <= 0:
        return ()
    notes = []
    for prepared, received in zip(relit.prepared, relit.received, strict=True):
        if prepared.source_lighting is None:
            continue
        weights = prepared.gaussians.opacities
        new = target.white * _mean_luminance(received, weights)
        old = source.white * _mean_luminance(prepared.source_lighting.irradiance, weights)
        if min(new, old) > 0:
            notes.append(_level_note(prepared.number, math.log2(target.mean / source.mean), new=new, old=old))
    return tuple(notes)


def _level_note(number: int, by_photos: float, *, new: float, old: float) -> Note:
    by_light = math.log2(new / old)
    plain = (
        f"Object {number}: by the exposure of the photos the new place is {_brighter(by_photos)} than the old one, by "
        f"the light on the object {_brighter(by_light)} ({_rounded(new)} lux there, {_rounded(old)} at the old place)."
    )
    doubts = ""
    if abs(by_light - by_photos) > _MAX_DIFFERENCE:
        doubts += (
            f" They differ by {abs(by_light - by_photos):.1f} stops: one of the lights may be wrong, or what the "
            f"photos of the two places show differs as much in reflectance."
        )
    if max(new, old) > _MAX_LUX:
        doubts += " That is more than sun and sky give: the estimated light is too strong, or the metadata is wrong."
    return Note(plain + doubts, "warning" if doubts else "said")


def _mean_luminance(irradiance: Float[Tensor, "n 3"], weights: Float[Tensor, "n"]) -> float:
    mean = (weights[:, None] * irradiance).sum(0) / weights.sum().clamp_min(1e-9)
    return float(mean @ LUMINANCE)


def _brighter(stops: float) -> str:
    return f"{abs(stops):.1f} stops {'brighter' if stops >= 0 else 'darker'}"


def _rounded(lux: float) -> str:
    """Two digits: no camera is calibrated better."""
    return f"{float(f'{lux:.2g}'):,.6g}"


def draw_light(found: EstimatedLight, scene: Gaussians, center: Float[Tensor, "3"]) -> Float[Tensor, "h w 3"]:
    """The panorama at the place, sources circled, and beside it the surfaces from above, coloured by their residual.

    Args:
        found: The estimate.
        scene: All Gaussians, without the object.
        center: The place, world units.

    Returns:
        sRGB in [0, 1].
    """
    frame = torch.stack([*tangents(found.evidence.up), found.evidence.up])
    return torch.cat([_panorama(found, scene, center, frame), _surfaces(found, center, frame)], 1)


def _panorama(
    found: EstimatedLight, scene: Gaussians, center: Float[Tensor, "3"], frame: Float[Tensor, "3 3"]
) -> Float[Tensor, "h w 3"]:
    height = math.pi * (0.5 - (torch.arange(_HEIGHT) + 0.5) / _HEIGHT)[:, None]
    turn = 2 * math.pi * ((torch.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) - 0.5)[None]
    flat = torch.stack([height.cos() * turn.cos(), height.cos() * turn.sin(), height.sin() + 0 * turn], -1)
    directions = (flat @ frame).reshape(-1, 3)
    nearest = 0.25 * float((found.evidence.surfaces.points - center).norm(dim=1).median()) if _has(found) else 0.0
    cube = render_panorama(scene, center, size=_FACE, nearest=nearest)
    shown = srgb_from_linear(cube.radiance.reshape(-1, 3)[cube_pixels(directions, _FACE)].clamp(0, 1))
    seen = found.evidence.around.seen[nearest_directions(directions)][:, None]
    image = (seen * shown + (1 - seen) * _UNSEEN).reshape(_HEIGHT, 2 * _HEIGHT, 3)
    canvas = np.ascontiguousarray((image * 255).byte().numpy())
    for source in found.light.sources:
        _circle(canvas, source, frame)
    return torch.from_numpy(canvas).float() / 255


def _circle(canvas: np.ndarray, source: LightSource, frame: Float[Tensor, "3 3"]) -> None:
    x, y, z = (frame @ torch.tensor(source.direction)).tolist()
    column = (math.atan2(y, x) / (2 * math.pi) + 0.5) * 2 * _HEIGHT
    row = (0.5 - math.asin(max(-1.0, min(1.0, z))) / math.pi) * _HEIGHT
    extent = math.hypot(source.angular_radius_deg, source.uncertainty_deg)
    at, radius = (round(column), round(row)), max(4, round(extent / 180 * _HEIGHT))
    cv2.circle(canvas, at, radius, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.circle(canvas, at, radius, (255, 220, 60), 1, cv2.LINE_AA)
    cv2.putText(canvas, source.name, (at[0] + radius + 3, at[1] + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 220, 60), 1)


def _surfaces(found: EstimatedLight, center: Float[Tensor, "3"], frame: Float[Tensor, "3 3"]) -> Float[Tensor, "h h 3"]:
    canvas = np.full((_HEIGHT, _HEIGHT, 3), 30, np.uint8)
    if not _has(found):
        return torch.from_numpy(canvas).float() / 255
    surfaces = found.evidence.surfaces
    places = (surfaces.points - center) @ frame.T
    reach = float(places[:, :2].abs().max())
    stops = (found.hidden.residual / math.log(2) / _STOPS).clamp(-1, 1)[:, None]
    colors = torch.where(stops > 0, _WHITE + stops * (_RED - _WHITE), _WHITE - stops * (_BLUE - _WHITE))
    pixels = ((places[:, :2] / reach * 0.48 + 0.5) * _HEIGHT).round().int()
    for i in places[:, 2].argsort().tolist():
        x, y = pixels[i].tolist()
        cv2.circle(canvas, (x, _HEIGHT - 1 - y), 3, (colors[i] * 255).tolist(), -1, cv2.LINE_AA)
    return torch.from_numpy(canvas).float() / 255


def _has(found: EstimatedLight) -> bool:
    return len(found.evidence.surfaces.points) > 0
