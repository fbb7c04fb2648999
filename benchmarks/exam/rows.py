"""The rows of the exam: pasting, the transfer with everything estimated, with more and more of the truth told, and what
new colours of the Gaussians can reach at all."""

from collections.abc import Mapping
from dataclasses import replace

import torch

from exam.scene_files import ExamScene
from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.evaluation.regions import find_regions
from splatgraft.relighting import Light, Relit, SourceScene, relight
from splatgraft.relighting.gain_transfer import relight_by_gain
from splatgraft.relighting.irradiance_ratio import relight_by_irradiance_ratio

ROWS: Mapping[str, str] = {
    "paste": "the object as it was captured",
    "gain": "one gain per channel, from the light around both places",
    "transplat": "the ratio of irradiances at each normal (TranSplat's diffuse path), both estimated; no shadow",
    "transfer": "the transfer, everything estimated",
    "told-new": "the transfer, told the true new light",
    "told-both": "the transfer, told both true lights",
    "told-both-and-normals": "the transfer, told both true lights and the true normals",
    "fitted": "no transfer: colours fitted to true pictures of the other views; no recolouring reaches much more",
}


def make_row(row: str, scene: ExamScene) -> tuple[Gaussians, Relit | None]:
    """The scene that a row gives.

    Returns:
        The scene to draw, and the transfer in layers where the row is one.

    Raises:
        ValueError: The row is unknown, or tells what is not known of this scene.
    """
    if row == "paste":
        return scene.composite.bake()[0], None
    if row == "gain":
        return relight_by_gain(scene.composite, scene.cameras, sources=[scene.source])[0].bake()[0], None
    if row == "transplat":
        return relight_by_irradiance_ratio(scene.composite, sources=[scene.source])[0].bake()[0], None
    if row == "fitted":
        return _fitted_to_truth(scene), None
    source, light = _told(row, scene)
    relit = relight(scene.composite, scene.cameras, sources=[source], light=light)
    return relit.bake()[0], relit


def _fitted_to_truth(scene: ExamScene) -> Gaussians:
    """The scene of `told-both` with colours that make the true object and the true shadow in the views of `cameras`.

    The shadow is the ratio of the true pictures with and without the object, on the target as it was reconstructed, so
    that errors of the reconstruction count as little as in the other rows.
    """
    told, _ = make_row("told-both", scene)
    images = []
    for view in scene.fitted_views:
        regions = find_regions(view.truth)
        with_object, without = (linear_from_srgb(image) for image in (view.truth.image, view.truth.background))
        shadowed = srgb_from_linear(linear_from_srgb(view.background) * with_object / without.clamp_min(1e-3))
        image = torch.where(regions.rest[..., None], view.picture(told), shadowed.clamp(0, 1))
        images.append(torch.where(regions.object[..., None], view.truth.image, image))
    return consolidate(told, scene.cameras, images, ConsolidateOptions(view_error=False))


def _told(row: str, scene: ExamScene) -> tuple[SourceScene, Light | None]:
    with_light = replace(scene.source, light=scene.old_light)
    if row == "transfer":
        return scene.source, None
    if row == "told-new":
        return scene.source, scene.new_light
    if row == "told-both":
        return with_light, scene.new_light
    if row != "told-both-and-normals":
        raise ValueError(f"--rows: expected names among {', '.join(ROWS)}; found {row}")
    if scene.normals is None:
        raise ValueError("there is no surface.npy")
    return replace(with_light, normals=scene.normals), scene.new_light
