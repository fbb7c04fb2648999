"""Learning rates of the fields of Gaussians, and their schedules over a fit."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.spherical_harmonics import coefficient_count


@dataclass(frozen=True)
class LearningRates:
    """Learning rate of Adam for each field; a field with rate 0 is frozen and no gradient is computed for it."""

    means: float = 0.0
    """World units per step at the start."""
    means_final: float = 0.0
    """World units per step at the end; the rate falls exponentially from `means` to it."""
    log_scales: float = 0.0
    """Natural logarithm of world units."""
    quaternions: float = 0.0
    """Raw quaternion components."""
    opacity_logits: float = 0.0
    """Before the sigmoid."""
    sh: float = 0.0
    """Band 0."""
    sh_higher: float = 0.0
    """Bands 1 to 3; 3DGS takes a twentieth of band 0."""
    final: float = 1.0
    """Factor on all rates but that of the means at the end; reached along half a cosine in the last third."""

    def active(self) -> tuple[str, ...]:
        """Names of the fields that are fitted."""
        rates = {
            "means": self.means,
            "log_scales": self.log_scales,
            "quaternions": self.quaternions,
            "opacity_logits": self.opacity_logits,
            "sh": self.sh + self.sh_higher,
        }
        return tuple(name for name, rate in rates.items() if rate > 0)

    def means_at(self, done: float) -> float:
        """Rate of the means after the share `done` in [0, 1] of all steps."""
        return self.means * (self.means_final / self.means) ** done if self.means_final > 0 else self.means

    def at(self, field: str, done: float, columns: int) -> Float[Tensor, "c"]:
        """Rate of each of the `columns` values of `field` per Gaussian, after the share `done` of all steps."""
        if field == "means":
            return torch.full((columns,), self.means_at(done))
        late = min(max(3 * done - 2, 0.0), 1.0)
        cosine = 0.5 + 0.5 * torch.cos(torch.tensor(torch.pi * late))
        left = self.final + (1 - self.final) * float(cosine)
        rates = torch.full((columns,), getattr(self, field) * left)
        if field == "sh":
            rates[3 * coefficient_count(0) :] = self.sh_higher * left
        return rates
