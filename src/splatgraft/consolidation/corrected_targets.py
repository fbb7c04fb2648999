"""Target images of all views with each view's estimated error (tint and flow) removed."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views, memory_bytes
from splatgraft.consolidation.view_errors import ViewError, ViewErrorOptions, no_view_error, refine


class CorrectedTargets:
    """The views' targets, each corrected by its `ViewError` (a few kB), which is refined while colours are fitted."""

    def __init__(self, views: Views, options: ViewErrorOptions | None) -> None:
        """Start without errors; with `options` None none are estimated."""
        self.views, self.options = views, options
        self._of_view: list[ViewError | None] = [None] * len(views)
        self._kept: dict[int, Tensor] | None = None

    def target(self, index: int) -> Float[Tensor, "h w 3"]:
        """The view's image, corrected by its error as estimated so far."""
        if self._kept is not None and index in self._kept:
            return self._kept[index]
        image, view_error = self.views.target(index), self._of_view[index]
        corrected = image if view_error is None else view_error.correct(image)
        if self._kept is not None and self.views.take_bytes(memory_bytes(corrected)):
            self._kept[index] = corrected
        return corrected

    def keep(self) -> None:
        """From now on keep corrected images in what the views leave of their cache; errors are not refined any more."""
        self._kept = {}

    def refine(self, index: int, render: Float[Tensor, "h w 3"]) -> None:
        """Refine the view's error against a render of the current scene."""
        assert self._kept is None
        if self.options is None:
            return
        image = self.views.target(index)
        known = self._of_view[index] or no_view_error(image, self.options)
        self._of_view[index] = refine(known, image, render.detach(), self.views.weight(index), self.options)

    def center(self) -> None:
        """Subtract the mean gain of all views from their errors, since it belongs to the scene."""
        gains = [n.log_gain.mean((0, 1)) for n in self._of_view if n is not None]
        if gains:
            mean = torch.stack(gains).mean(0)
            self._of_view = [n and replace(n, log_gain=n.log_gain - mean) for n in self._of_view]
