"""Where a scene's dominant light comes from, told by what glints in it.

Almost every surface is a little glossy: seen from where it mirrors the light it is brighter. How the colour of each
Gaussian changes from view to view is compared with what a light in each direction would do to it. Needs no shadows:
a bare table top tells it. Knows nothing about panoramas, objects or files.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.camera_visibility import seen_from, spread_over

_VIEWERS = 20
_RECEIVERS = 2000
_FEWEST = 200
_FLATTEST = 0.1  # cosine
# the lobe is cos^8, 24 degrees wide at half height: as narrow as harmonics of degree 3 hold, wide enough for windows
_SQUARINGS = 3
_CHUNK = 16


@dataclass(frozen=True)
class Highlights:
    """How m Gaussians look from v cameras that see them."""

    mirrored: Float[Tensor, "m v 3"]
    """Unit, where light comes from that is mirrored into the camera."""
    change: Float[Tensor, "m v"]
    """Linear gray above the Gaussian's mean over its cameras."""
    weight: Float[Tensor, "m v"]
    """0 where the camera does not see it."""

    def explained(self, directions: Float[Tensor, "d 3"]) -> Float[Tensor, "d"]:
        """Share of all change from view to view that one light in each of `directions` explains, in [0, 1]."""
        total = (self.weight * self.change**2).sum().clamp_min(1e-12)
        shares = []
        for some in directions.split(_CHUNK):
            lobe = (self.mirrored @ some.T).clamp_min(0)
            for _ in range(_SQUARINGS):
                lobe = lobe * lobe
            lobe = lobe - _mean(lobe, self.weight[..., None])
            both = (self.weight[..., None] * lobe * self.change[..., None]).sum((0, 1)).clamp_min(0)
            own = (self.weight[..., None] * lobe * lobe).sum((0, 1)).clamp_min(1e-12)
            shares.append(both**2 / (own * total))
        return torch.cat(shares).clamp(0, 0.99)


def find_highlights(
    scene: Gaussians, normals: Normals, cameras: Cameras, *, center: Float[Tensor, "3"], radius: float
) -> Highlights | None:
    """What glints within `radius` of `center`; None where colours are the same from everywhere, or few are seen."""
    inside = (scene.means - center).norm(dim=1) < radius
    good = inside & normals.seen & (scene.opacities > 0.3) & (normals.confidence > 0.3)
    chosen = good.nonzero()[:, 0]
    if len(chosen) < _FEWEST or scene.sh_degree == 0 or len(cameras) < 3:
        return None
    chosen = chosen[torch.randperm(len(chosen), generator=torch.Generator().manual_seed(0))[:_RECEIVERS]]
    some, facing = scene.select(chosen), normals.vectors[chosen]
    viewers = spread_over(cameras, count=_VIEWERS)
    seen = torch.stack([seen_from(some, cameras[i], among=scene) for i in viewers], 1)
    towards = torch.nn.functional.normalize(cameras.centers[viewers][None] - some.means[:, None], dim=-1)
    cosine = (towards * facing[:, None]).sum(-1)
    basis = spherical_harmonics.basis(-towards.reshape(-1, 3), some.sh_degree).reshape(*towards.shape[:2], -1)
    rgb = torch.einsum("mvk,mkc->mvc", basis, some.sh) + 0.5
    gray = linear_from_srgb(rgb.clamp(0, 1)).mean(-1)
    width = some.scales.sort(1).values[:, 1:].prod(1).sqrt()
    weight = seen * (cosine > _FLATTEST) * (some.opacities * normals.confidence[chosen] * width)[:, None]
    if int((weight > 0).sum()) < _FEWEST:
        return None
    return Highlights(
        mirrored=2 * cosine[..., None] * facing[:, None] - towards,
        change=gray - _mean(gray, weight),
        weight=weight / weight.sum(),
    )


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (weight * values).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-12)
