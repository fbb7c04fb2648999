"""The edits of a project as one immutable value."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from jaxtyping import Bool, Int8
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.relighting import LayerWeights, Light

BoxNumbers = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class EditState:
    """The current edits. None means that project.toml has no entry and the step's default applies."""

    objects: tuple[ObjectPlacement, ...] | None = None
    """Placed objects; one without a path is the project's own object. None: `compose` finds a place."""
    erased: Bool[Tensor, "n"] | None = None
    """Gaussians of the target that are erased."""
    corrections: Int8[Tensor, "m"] | None = None
    """Per Gaussian of the source: 1 added to the object by hand, -1 removed, 0 unchanged."""
    mask_source: str | None = None
    """Source of the object's masks: `mask_source` of [segment]."""
    box: BoxNumbers | None = None
    """Box around the object in the source's world: minimum x, y, z, then maximum."""
    keep: str | None = None
    """Which connected pieces of the selection are kept: `keep` of [segment]."""
    prompts: Mapping[str, ViewPrompt] | None = None
    """Points and rectangles in photos of the source, by the photo's name: `prompts` of [segment]."""
    light: Light | None = None
    """The light set by hand; None: it is estimated."""
    weights: LayerWeights = field(default_factory=LayerWeights)
    """Strength of each layer of the light transfer."""
    harmonizer: str | None = None
    """Name of the harmonisation method."""

    def with_object(self, index: int, item: ObjectPlacement) -> "EditState":
        """The state with another placement of one object."""
        assert self.objects is not None
        return replace(self, objects=(*self.objects[:index], item, *self.objects[index + 1 :]))
