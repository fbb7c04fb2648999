"""Compare the bananas' shadow in a finished demo with the cup's beside it: darkness, and width of the edge.

    splatgraft demo demo && python benchmarks/demo_shadow.py demo [demo-of-another-version ...]

The sun of the rendered table is known (data/render_table.py), so it is known which texels of the table top the cup and
the bananas shade.

- Darkness: median of luminance in the core of a shadow over luminance without the shadow. The latter is the lit table's
  for the cup, and the same texel's without the bananas for the bananas.
- Width: distance over which the mean profile of that ratio across the edge goes from a fifth to four fifths of its
  change.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.images import LUMINANCE
from splatgraft.folders.composite_folder import read_composite
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.sun import SurfacePicture, draw_surface, find_surfaces, standing_on
from splatgraft.relighting.shadows.shadow_maps import occluders_of

SUN = F.normalize(torch.tensor([-0.26938, 0.91658, 0.29548]), dim=0)
"""Direction towards the sun of data/render_table.py."""
_RADII = 6.4  # object radii of the region around the table
_CORE, _REACH = 3, 14
"""Distances from the edge, texels: the minimum at which a shadow is darkest, and the maximum of the profile."""


def luminance(picture: SurfacePicture) -> Float[Tensor, "s s"]:
    """Return linear luminance, nan if the surface is not seen."""
    return torch.where(picture.valid, picture.log_rgb.exp() @ LUMINANCE, math.nan)


def measured(
    ratio: Float[Tensor, "s s"], visible: Float[Tensor, "s s"], apart: Bool[Tensor, "s s"]
) -> tuple[float, float]:
    """Return darkness in the core, and the width of the edge in texels. `apart` marks texels near another shadow."""
    shaded = visible.numpy() < 0.5
    away = np.asarray(distance_transform_edt(shaded)) - np.asarray(distance_transform_edt(~shaded))
    known = ~(ratio.isnan() | apart).numpy()
    dark = float(np.median(ratio.numpy()[known & (away > _CORE)]))
    bins = np.arange(-_REACH, _CORE + 2)
    values = [ratio.numpy()[known & (np.floor(away) == b)] for b in bins]
    bins, profile = bins[[v.size > 0 for v in values]], np.array([np.median(v) for v in values if v.size])
    lit = float(profile[0])
    share = np.maximum.accumulate(np.clip((lit - profile) / (lit - dark), 0, 1))
    start, end = (float(np.interp(level, share, bins)) for level in (0.2, 0.8))
    return dark, end - start


def shadows_of(demo: Path, folders: tuple[str, ...]) -> Iterator[tuple[str, float, float]]:
    """Yield name, darkness and edge width in mm of the cup's shadow, and of the bananas' in results of a demo."""
    composite = read_composite(demo / "target" / "scene" / "scene.ply", demo / "composite" / "placement.json")
    cameras = read_cameras(demo / "target" / "capture" / "transforms.json")
    scene, placed = composite.target, composite.objects[0].in_target()
    place = bounding_sphere(placed)
    region = BoundingSphere(place.center, _RADII * place.radius)
    captured = CapturedScene(scene, cameras)
    surface = find_surfaces(captured, region)[0]
    cup = surface.shadows(standing_on(surface, scene, region), SUN[None])[0]
    bananas = surface.shadows(occluders_of(placed), SUN[None])[0]
    table = luminance(draw_surface(captured, surface))
    lit = float(table[(cup > 0.99) & ~table.isnan()].median())
    under = (surface.texels() - place.center).norm(dim=-1) < place.radius
    texel = 2000 * surface.half / len(cup)
    rows = [("cup", table / lit, cup, bananas < 0.99)]
    for folder in folders:
        after = CapturedScene(read_gaussians(demo / folder / "scene.ply"), cameras)
        shown = luminance(draw_surface(after, surface))
        rows.append((f"bananas, {folder}", shown / table, bananas, (cup < 0.99) | under))
    for name, ratio, visible, apart in rows:
        dark, width = measured(ratio, visible, apart)
        yield name, dark, width * texel


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demos", type=Path, nargs="+", help="folders that `splatgraft demo` finished")
    for demo in parser.parse_args().demos:
        for name, dark, width in shadows_of(demo, ("relit", "result")):
            print(f"{demo.name:20} {name:18} darkness {dark:.2f}, edge {width:.0f} mm wide", flush=True)


if __name__ == "__main__":
    main()
