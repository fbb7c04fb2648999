"""What inverse-rendering programs add to the layout of the original code, and what is left out of it on reading.

Names and meanings as in the public code of the three:

- GS-IR (Liang et al. 2024): normal_0..2, albedo_0..2, roughness, metallic; f_dc and f_rest are SH, fitted to the
  photographs before the material is.
- GaussianShader (Jiang et al. 2024): nx2 ny2 nz2, roughness, specular0..2. f_dc is no SH: the diffuse colour is
  sigmoid(f_dc - ln 3). f_rest is a residual with its own band 0, coefficient by coefficient; the light adds the rest.
- 3DGS-DR (Ye et al. 2024): refl, a logit. A picture is (1 - refl) times the SH's colour, plus refl times a reflection
  of the environment map in a .map file beside.
"""

import math
import re

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.formats.scenes import ply

REFLECTION = "refl"
_GS_IR = frozenset({"albedo_0", "roughness", "metallic"})
_SHADER = frozenset({"nx2", "ny2", "nz2", "roughness", "specular0"})
_KNOWN = re.compile(
    r"x|y|z|n[xyz]|f_dc_[0-2]|f_rest_[0-9]+|opacity|scale_[0-2]|rot_[0-3]|filter_3D|red|green|blue|alpha"
)
"""Properties that are read, empty normals, and colours for viewers."""
_NAMED = 6
"""Most properties that a note names."""
_REFLECTIVE = 0.1
"""Share above which 3DGS-DR's code calls a Gaussian reflective."""


def is_gaussian_shader(vertex: ply.Element) -> bool:
    """Whether f_dc and f_rest are those of GaussianShader, trained with its shading."""
    return set(vertex.names) >= _SHADER


def shader_sh(raw_diffuse: Float[Tensor, "n 3"], residual: Float[Tensor, "n k 3"]) -> Float[Tensor, "n c 3"]:
    """SH of GaussianShader's colours without what its light adds: the diffuse colour and the residual.

    Args:
        raw_diffuse: f_dc of its file.
        residual: f_rest of its file, by coefficient from band 0 on; k may be 0.
    """
    band0 = spherical_harmonics.dc_from_rgb(torch.sigmoid(raw_diffuse - math.log(3.0)))[:, None]
    if not residual.shape[1]:
        return band0
    return torch.cat([band0 + residual[:, :1], residual[:, 1:]], 1)


def left_out_notes(vertex: ply.Element, reflection: Float[Tensor, "n"] | None) -> tuple[str, ...]:
    """What of the file is not used, for the user.

    Args:
        vertex: With all properties of the file.
        reflection: 3DGS-DR's refl as stored; None where the file has none.
    """
    names = set(vertex.names)
    if is_gaussian_shader(vertex):
        return (
            "GaussianShader: colours are its diffuse part and its residual; what its light adds (specular0 .., "
            "roughness, second normals, the environment map beside the file) is left out",
        )
    if names >= _GS_IR:
        return (
            "GS-IR: colours are its SH, fitted to the photographs; material and normals (albedo_0 .., roughness, "
            "metallic, normal_0 ..) and the light in its checkpoint are left out",
        )
    if reflection is not None:
        share = float((torch.sigmoid(reflection) > _REFLECTIVE).float().mean()) if len(reflection) else 0.0
        return (
            "3DGS-DR: colours are its base colour; the reflections that refl mixes in, and their environment map "
            f"(.map), are left out: {share:.0%} of the Gaussians reflect by more than {_REFLECTIVE:g}",
        )
    unused = [name for name in vertex.names if not _KNOWN.fullmatch(name)]
    if not unused:
        return ()
    more = f" and {len(unused) - _NAMED} more" if len(unused) > _NAMED else ""
    return (f"not used: the properties {', '.join(unused[:_NAMED])}{more}",)
