"""Writes a scene, one of its layers, or pictures of it; the file's suffix chooses the format."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.exports.export_source import ExportSource, first_view, path_around, upright
from splatgraft.exports.pages import write_viewer_page
from splatgraft.exports.pictures import write_picture, write_turntable
from splatgraft.exports.shadow_layer import shadow_layer
from splatgraft.formats import WRITTEN_SCENE_SUFFIXES, scene_suffix, write_gaussians
from splatgraft.formats.scenes.spz import write_spz
from splatgraft.runtime.progress import Progress, silent

_WORLD_SUFFIX = ".glb"  # its y points up and its unit is a metre

_WIDTH = 1280
_MIN_WIDTH = 16  # pixels
_PART_BACKGROUND = 0.8  # grey on which a page shows an object or a shadow alone, sRGB

_PICTURES, _TURNTABLES = (".png", ".jpg"), (".mp4", ".gif", ".webp")
EXPORT_SUFFIXES = (".html", *WRITTEN_SCENE_SUFFIXES, *_PICTURES, *_TURNTABLES)
"""Suffixes of the files that can be written."""

Layer = Literal["all", "object", "scene", "scene-with-shadow", "shadow", "object-with-shadow"]


@dataclass(frozen=True)
class ExportOptions:
    """Layer, frame and precision of an export."""

    layer: Layer = "all"
    """all: the whole scene; object: the relit object alone; scene: the place without object and shadow;
    scene-with-shadow: the place with the object's shadow and bounce, for those who draw the object itself as a mesh;
    shadow: black Gaussians that darken a picture behind them as the shadow does; object-with-shadow: both, for a
    compositor."""
    frame: Literal["auto", "capture", "world"] = "auto"
    """Frame of a scene. capture: as in the project; world: upright and in metres, as far as they are known; auto: world
    for .glb, which asks for it, else capture."""
    spz_version: int = 4
    """Version of a .spz: 4, or 3 for programs that do not read 4 yet."""
    sh_degree: int = 3
    """Highest SH degree that is written, 0 to 3; with a lower one files are smaller and highlights move less."""
    width: int | None = None
    """Width of pictures and videos, pixels; 1280 by default, for a turntable no more than the captured images have."""
    frames: int = 120
    """Number of pictures of a turntable, 24 per second."""


def export_scene(
    source: ExportSource, to: Path, options: ExportOptions = ExportOptions(), *, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a file atomically.

    Args:
        source: The scene, with its parts and cameras if they are known.
        to: A file whose suffix is among `EXPORT_SUFFIXES`.
        options: Layer, frame and precision.
        progress: Called in the steps of a shadow's fit and for the pictures of a turntable.

    Returns:
        Sentences for the user, on assumptions, Gaussians left out and the frame.

    Raises:
        ValueError: The suffix is unknown, an option is out of range, or the source lacks the requested layer.
    """
    suffix = scene_suffix(to)
    if suffix not in EXPORT_SUFFIXES:
        raise ValueError(f"{to}: expected a file that ends in {', '.join(EXPORT_SUFFIXES)}, found '{to.suffix}'")
    if not 0 <= options.sh_degree <= spherical_harmonics.MAX_DEGREE:
        raise ValueError(f"--sh-degree: expected 0 to {spherical_harmonics.MAX_DEGREE}, found {options.sh_degree}")
    width = _WIDTH if options.width is None else options.width
    if width < _MIN_WIDTH:
        raise ValueError(f"--width: expected {_MIN_WIDTH} pixels or more, found {width}")
    gaussians, said = layer_of(source, options.layer, progress=progress)
    gaussians = _limited(gaussians, options)
    if suffix in WRITTEN_SCENE_SUFFIXES:
        return (*said, *_write_scene(to, gaussians, source, options))
    view, assumed = first_view(source)
    said = (*said, *assumed)
    if suffix in _TURNTABLES:
        if options.width is None and source.cameras is not None:
            width = min(width, int(source.cameras.sizes[0, 0]))
        cameras = path_around(source, view, frames=options.frames, width=width)
        return (*said, write_turntable(to, gaussians, cameras, progress=progress))
    if suffix in _PICTURES:
        with_alpha = options.layer != "all" and suffix == ".png"
        write_picture(to, gaussians, view, width=width, with_alpha=with_alpha)
        return said
    scenes = {source.title: gaussians}
    if options.layer == "all" and source.pasted is not None:
        scenes = {"Before": _limited(_finite(source.pasted)[0], options), "After": gaussians}
    background = 0.0 if options.layer in ("all", "scene", "scene-with-shadow") else _PART_BACKGROUND
    write_viewer_page(to, scenes, view, title=source.title, background=background)
    return said


def _write_scene(to: Path, gaussians: Gaussians, source: ExportSource, options: ExportOptions) -> tuple[str, ...]:
    metadata, suffix, said = source.metadata, scene_suffix(to), ()
    if options.frame == "world" or (options.frame == "auto" and suffix == _WORLD_SUFFIX):
        world_from_capture, metadata, said = upright(source)
        gaussians = world_from_capture.gaussians(gaussians)
    if suffix == ".spz":
        write_spz(to, gaussians, version=options.spz_version)
    else:
        write_gaussians(to, gaussians, metadata=metadata)
    return said


def layer_of(source: ExportSource, layer: Layer, *, progress: Progress = silent) -> tuple[Gaussians, tuple[str, ...]]:
    """Make one layer, without Gaussians that are not finite, and sentences on it; ValueError if layers are unknown."""
    if layer == "all":
        return _finite(source.scene)
    if source.is_object is None or source.place is None:
        raise ValueError(
            f"--layer {layer}: expected the folder of a project, whose parts are known, found {source.title} alone"
        )
    if layer == "scene":
        return _finite(source.place)
    if layer == "scene-with-shadow":
        return _finite(source.scene.select(~source.is_object))
    object_ = source.scene.select(source.is_object)
    if layer == "object":
        return _finite(object_)
    shadow = shadow_layer(source, progress=progress)
    if shadow.psnr is None:
        said = "the object casts no shadow that the target's cameras see"
    else:
        said = (
            f"the shadow has {shadow.gaussians.count:,} black Gaussians that darken the picture behind them; over the "
            f"empty place it gives the scene's shadow with {shadow.psnr:.1f} dB PSNR in views outside its fit"
        )
    parts = [shadow.gaussians] if layer == "shadow" else [object_, shadow.gaussians]
    chosen, left_out = _finite(concatenate(parts))
    return chosen, (said, *left_out)


def _limited(gaussians: Gaussians, options: ExportOptions) -> Gaussians:
    """Drop SH bands above the requested degree."""
    return gaussians.with_sh_degree(min(options.sh_degree, gaussians.sh_degree))


def _finite(gaussians: Gaussians) -> tuple[Gaussians, tuple[str, ...]]:
    fields = [gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh.flatten(1)]
    finite = torch.isfinite(torch.cat(fields, 1)).all(1) & ~gaussians.opacity_logits.isnan()
    if bool(finite.all()):
        return gaussians, ()
    return gaussians.select(finite), (f"{int((~finite).sum())} Gaussians that are not finite are left out",)
