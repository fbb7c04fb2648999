"""The targets of all views, each without its own error. Knows nothing about how colours are fitted."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views
from splatgraft.consolidation.view_errors import Nuisance, NuisanceOptions, no_nuisance, refine


class Corrections:
    """One `Nuisance` per view (a few kB each), refined against renders while the colours are fitted."""

    def __init__(self, views: Views, options: NuisanceOptions | None) -> None:
        """No error known yet; None: none is ever looked for."""
        self.views, self.options = views, options
        self._of_view: list[Nuisance | None] = [None] * len(views)

    def target(self, index: int) -> Float[Tensor, "h w 3"]:
        """The view's image without its error, as far as known."""
        image, nuisance = self.views.target(index), self._of_view[index]
        return image if nuisance is None else nuisance.correct(image)

    def refine(self, index: int, render: Float[Tensor, "h w 3"]) -> None:
        """Solve the view's error again, against what the scene looks like now."""
        if self.options is None:
            return
        image = self.views.target(index)
        known = self._of_view[index] or no_nuisance(image, self.options)
        self._of_view[index] = refine(known, image, render.detach(), self.views.weight(index), self.options)

    def center(self) -> None:
        """Take the mean gain of all views, which belongs to the scene, out of their errors."""
        gains = [n.log_gain.mean((0, 1)) for n in self._of_view if n is not None]
        if gains:
            mean = torch.stack(gains).mean(0)
            self._of_view = [n and replace(n, log_gain=n.log_gain - mean) for n in self._of_view]
