"""Light transfer by one gain per object and channel, from the light around its two places; casts no shadow."""

from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import NoLight, panorama_at
from splatgraft.relighting.shading.gain import GainOptions, LocalGain, apply_gain, local_gain
from splatgraft.relighting.transfer import SourceScene

PASTED = "It is pasted as it is."
"""End of the sentence on an object that stays as it was captured."""


def relight_by_gain(
    composite: Composite,
    cameras: Cameras,
    *,
    sources: Sequence[SourceScene | None],
    options: GainOptions = GainOptions(),
) -> tuple[Composite, tuple[str, ...]]:
    """Adjust exposure and white balance of every object in a composite.

    Args:
        composite: Target scene and placed objects.
        cameras: Of the target's capture.
        sources: Per object the scene that it was taken from; None where that is not known.
        options: Limits of a gain.

    Returns:
        The composite and a sentence on each object. An object stays as it was captured where its source is not known
        or there is no light at one of its places, and the sentence gives the reason.

    Raises: ValueError where there is not one source (or None) per object.
    """
    if len(sources) != len(composite.objects):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    scene = composite.target.select(~composite.erased)
    recolored, report = [], []
    for number, (placed, source) in enumerate(zip(composite.objects, sources, strict=True), start=1):
        name = f"Object {number}: "
        gain: LocalGain | str = "The scene it comes from is not known."
        if placed.gaussians.count == 0:
            gain = "It is empty."
        elif source is not None:
            target = _Place(scene, cameras, bounding_sphere(placed.in_target()))
            origin = _Place(source.gaussians, source.cameras, bounding_sphere(placed.gaussians))
            gain = _gain_between(origin, target, options)
        if isinstance(gain, LocalGain):
            recolored.append(apply_gain(placed.gaussians, gain.gain))
            report.append(name + gain.describe())
        else:
            recolored.append(placed.gaussians)
            report.append(f"{name}{gain} {PASTED}")
    return composite.with_object_colors(tuple(recolored)), tuple(report)


@dataclass(frozen=True)
class _Place:
    """An object's place in a scene."""

    scene: Gaussians
    cameras: Cameras
    sphere: BoundingSphere


def _gain_between(source: _Place, target: _Place, options: GainOptions) -> LocalGain | str:
    """The gain from the object's old place to its new one, or a sentence that gives the reason why there is none."""
    target_panorama = panorama_at(target.scene, target.sphere)
    if isinstance(target_panorama, NoLight):
        return f"In the target: {target_panorama.reason}"
    source_panorama = panorama_at(source.scene, source.sphere)
    if isinstance(source_panorama, NoLight):
        return f"In the source: {source_panorama.reason}"
    source_up, target_up = estimate_up(source.cameras), estimate_up(target.cameras)
    return local_gain(source_panorama, target_panorama, source_up=source_up, target_up=target_up, options=options)
