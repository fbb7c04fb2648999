"""The rows of the exam: pasting, the transfer with everything estimated, and with more and more of the truth told."""

from collections.abc import Mapping
from dataclasses import replace

from exam.scene_files import ExamScene
from splatgraft.core.gaussians import Gaussians
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
    source, light = _told(row, scene)
    relit = relight(scene.composite, scene.cameras, sources=[source], light=light)
    return relit.bake()[0], relit


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
