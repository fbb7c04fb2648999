"""Writes OpenUSD scenes (.usdz) with the schema ParticleField3DGaussianSplat of UsdVol, which USD has since 26.03.

Positions, linear scales, orientations, linear opacities and SH coefficients as float32, those of a particle side by
side. USD's y points up, and metersPerUnit says how large a unit is. Needs usd-core (the extra `usd`).
"""

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.formats.scenes.quantization import writable
from splatgraft.formats.scenes.scene_file import SceneMetadata

_AXES = "RUB"
_SIGMAS = 3.0  # standard deviations that the extent holds


def write_gaussian_usdz(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write a package with one prim /Scene/Gaussians, of 1 m per unit where that is not known."""
    from pxr import Usd, UsdGeom, UsdUtils, UsdVol

    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        found = ".".join(map(str, Usd.GetVersion()[1:]))
        raise ValueError(f"{path}: expected OpenUSD 26.3 or later, which has Gaussians, found {found}")
    g = writable(path, gaussians)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    with tempfile.TemporaryDirectory(prefix=".splatgraft_usd_", dir=path.parent) as folder:
        layer, package = Path(folder) / "scene.usdc", Path(folder) / "scene.usdz"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, metadata.metres_per_unit or 1.0)
        scene = UsdGeom.Xform.Define(stage, "/Scene")
        stage.SetDefaultPrim(scene.GetPrim())
        _define(UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Scene/Gaussians"), g)
        stage.GetRootLayer().Save()
        if not UsdUtils.CreateNewUsdzPackage(str(layer), str(package)):
            raise ValueError(f"{path}: expected OpenUSD to make a package, found that it could not")
        os.replace(package, path)


def _define(prim: Any, gaussians: Gaussians) -> None:
    """Set the attributes of a ParticleField3DGaussianSplat."""
    from pxr import UsdGeom, Vt

    g = change_axes(gaussians, rdf_from(_AXES).T)
    reach = _SIGMAS * g.scales.amax(1, keepdim=True)
    extent = torch.stack([(g.means - reach).amin(0), (g.means + reach).amax(0)])
    unit = torch.nn.functional.normalize(g.quaternions, dim=1)
    xyzw = np.ascontiguousarray(unit[:, [1, 2, 3, 0]].numpy())  # in USD the real part lies last in memory
    prim.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(g.means.contiguous().numpy()))
    prim.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(g.scales.contiguous().numpy()))
    prim.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(xyzw))
    prim.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(g.opacities.numpy()))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(g.sh_degree)
    coefficients = Vt.Vec3fArray.FromNumpy(g.sh.reshape(-1, 3).contiguous().numpy())
    harmonics = prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
    harmonics.SetMetadata("elementSize", g.sh.shape[1])
    harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent.numpy()))
    color = spherical_harmonics.rgb_from_dc(g.sh[:, 0]).clamp(0, 1).contiguous()
    shown = prim.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(color.numpy()))
    shown.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
