"""Light transfer by one gain for each object and channel: exposure and white balance alone, without shadows.

The gain is the mean light around the object's new place over that around its old one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.panorama import NoLight, Panorama, panorama_at
from splatgraft.relighting.prepared_object import SourceScene
from splatgraft.relighting.shading import apply_gain
from splatgraft.runtime.note import Note

# set by hand
_DARKEST = 1e-4  # linear light, a third of one 8-bit step; lower bound of the mean light
_MAX_LOG_GAIN = math.log(4.0)  # maximum change of a channel
_MAX_LOG_TINT = math.log(1.6)  # maximum difference of a channel from the mean; more is likely a coloured wall
_TRUSTED_COVERAGE = 0.5  # captured share of the directions below which the gain is moved towards 1 in proportion


@dataclass(frozen=True)
class LocalGain:
    """The gain of one object."""

    gain: Float[Tensor, "3"]
    """Factor on linear rgb."""
    source_coverage: float
    """Share of the old light's directions that the source's capture covers, in [0, 1]."""
    target_coverage: float
    """Share of the new light's directions that the target's capture covers, in [0, 1]."""
    held_back: bool
    """Whether a limit or missing coverage made the gain smaller than measured."""


def relight_by_gain(
    composite: Composite, cameras: Cameras, *, sources: Sequence[SourceScene | None]
) -> tuple[Composite, tuple[Note, ...]]:
    """Adjust exposure and white balance of every object in a composite.

    Args:
        composite: Target scene and placed objects.
        cameras: The cameras of the target's capture.
        sources: For each object the scene that it was taken from; None if that is unknown.

    Returns:
        The composite and a note on each object. If an object's source is unknown or if there is no light at one of its
        places, it stays as it was captured, and a warning gives the reason.

    Raises:
        ValueError: There is not one source (or None) per object.
    """
    if len(sources) != len(composite.objects):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    scene = composite.target.select(~composite.erased)
    recolored, notes = [], []
    for number, (placed, source) in enumerate(zip(composite.objects, sources, strict=True), start=1):
        found = _gain_of(placed, source, scene, cameras)
        if isinstance(found, LocalGain):
            recolored.append(apply_gain(placed.gaussians, found.gain))
            notes.append(Note(f"Object {number}: {_describe(found)}"))
        else:
            recolored.append(placed.gaussians)
            notes.append(Note(f"Object {number}: {found} It is pasted as it is.", "warning"))
    return composite.with_object_colors(tuple(recolored)), tuple(notes)


def _describe(found: LocalGain) -> str:
    r, g, b = found.gain.tolist()
    text = (
        f"Exposure and white balance: red x{r:.2f}, green x{g:.2f}, blue x{b:.2f}. "
        f"Directions of light that were never photographed: {1 - found.source_coverage:.0%} in the source, "
        f"{1 - found.target_coverage:.0%} in the target."
    )
    return text + (" The measured change was larger and was held back." if found.held_back else "")


def _gain_of(placed: PlacedObject, source: SourceScene | None, scene: Gaussians, cameras: Cameras) -> LocalGain | str:
    """Compute the gain from the object's old place to its new one, or say why it is unknown."""
    if not placed.gaussians.count:
        return "It is empty."
    if source is None:
        return "The scene it comes from is not known."
    target_panorama = panorama_at(scene, bounding_sphere(placed.in_target()))
    if isinstance(target_panorama, NoLight):
        return f"In the target: {target_panorama.reason}"
    source_panorama = panorama_at(source.gaussians, bounding_sphere(placed.gaussians))
    if isinstance(source_panorama, NoLight):
        return f"In the source: {source_panorama.reason}"
    ups = estimate_up(source.cameras), estimate_up(cameras)
    return local_gain(source_panorama, target_panorama, source_up=ups[0], target_up=ups[1])


def local_gain(
    source: Panorama, target: Panorama, *, source_up: Float[Tensor, "3"], target_up: Float[Tensor, "3"]
) -> LocalGain:
    """Divide the mean light at an object's new place by that at its old one, for each channel, within limits.

    Args:
        source: Panorama at the old place, with the object removed.
        target: Panorama at the new place. The gain is 1 if one of the two covers nothing.
        source_up: Unit, in the source's frame.
        target_up: Unit, in the target's frame.
    """
    source_light, source_coverage = mean_light(source, source_up)
    target_light, target_coverage = mean_light(target, target_up)
    measured = (target_light.clamp_min(_DARKEST) / source_light.clamp_min(_DARKEST)).log()
    exposure = measured.mean()
    bounded = exposure + (measured - exposure).clamp(-_MAX_LOG_TINT, _MAX_LOG_TINT)
    share = min(1.0, min(source_coverage, target_coverage) / _TRUSTED_COVERAGE)
    gain = (bounded.clamp(-_MAX_LOG_GAIN, _MAX_LOG_GAIN) * share).exp()
    held_back = bool((gain.log() - measured).abs().max() > 1e-3)
    return LocalGain(gain, source_coverage, target_coverage, held_back)


def mean_light(panorama: Panorama, up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], float]:
    """Average the radiance that reaches a dome on a surface.

    The mean over all normals of the upper hemisphere weights light from direction d by (1 + d . up) / 2, the integral
    of the clamped cosine. Uncaptured directions count as bright as the mean of the others.

    Args:
        panorama: At the dome's place.
        up: Unit, the axis of the dome.

    Returns:
        Linear rgb radiance, and the weighted share of directions that were captured, in [0, 1].
    """
    cosine = panorama.directions @ torch.nn.functional.normalize(up, dim=0).to(panorama.directions)
    weight = (1 + cosine) / 2 * panorama.solid_angles
    seen = weight * panorama.alpha
    light = (panorama.radiance * seen[..., None]).sum((0, 1, 2)) / seen.sum().clamp_min(1e-12)
    return light, float(seen.sum() / weight.sum())
