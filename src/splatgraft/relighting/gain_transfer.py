"""The first form of light transfer, whole: each object under the gain between its two places. Casts no shadow."""

from collections.abc import Sequence

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import panorama_at
from splatgraft.relighting.shading.gain import GainOptions, LocalGain, apply_gain, local_gain
from splatgraft.relighting.transfer import SourceScene


def relight_by_gain(
    composite: Composite,
    cameras: Cameras,
    *,
    sources: Sequence[SourceScene | None],
    options: GainOptions = GainOptions(),
) -> tuple[Composite, tuple[str, ...]]:
    """`composite` with exposure and white balance of every object adjusted, and a sentence on each.

    `cameras` are the target's; `sources` holds, per object, the scene it was taken from. Where that is unknown, or
    one of the places shows no light, the object stays as it was captured and the sentence says so.

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
            place = bounding_sphere(placed.in_target())
            gain = _gain_between((scene, place, cameras), (source, bounding_sphere(placed.gaussians)), options)
        if isinstance(gain, LocalGain):
            recolored.append(apply_gain(placed.gaussians, gain.gain))
            report.append(name + gain.describe())
        else:
            recolored.append(placed.gaussians)
            report.append(f"{name}{gain} It is pasted as it is.")
    return composite.with_object_colors(tuple(recolored)), tuple(report)


def _gain_between(
    target: tuple[Gaussians, BoundingSphere, Cameras], origin: tuple[SourceScene, BoundingSphere], options: GainOptions
) -> LocalGain | str:
    """The gain from the object's old place to its new one, or a sentence that says why there is none."""
    scene, place, cameras = target
    source, own_place = origin
    after, problem = panorama_at(scene, place)
    if after is None:
        return f"In the target: {problem}"
    before, problem = panorama_at(source.gaussians, own_place)
    if before is None:
        return f"In the source: {problem}"
    source_up, target_up = estimate_up(source.cameras), estimate_up(cameras)
    return local_gain(before, after, source_up=source_up, target_up=target_up, options=options)
