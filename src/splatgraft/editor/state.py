"""The edits of a project as an immutable value, and the limits of its numbers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import get_args

import torch
from jaxtyping import Bool, Int8
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt
from splatgraft.folders.object_masks import MaskSource
from splatgraft.harmonization import HARMONIZERS
from splatgraft.project.placement import ObjectPlacement
from splatgraft.relighting import LayerWeights, Light, light_from_json, light_to_json
from splatgraft.segmentation import Keep

BoxNumbers = tuple[float, float, float, float, float, float]

_SCALES = (1e-6, 1e6)
"""Range of an object's scale; beyond it covariances leave the range of float32."""
_COORDINATES = (-1e6, 1e6)
"""World units; beyond, the resolution of float32 is coarser than about 0.1."""
_HEIGHTS_CM = (1e-3, 1e7)
"""Heights that can be typed: from a hundredth of a millimetre to a hundred kilometres."""
_WEIGHTS, _STOPS = (0.0, 100.0), (-16.0, 16.0)
"""Weights of layers of the light transfer, and exposure and warmth in stops."""
_ORTHONORMAL = 1e-3
"""Largest deviation of a rotation from orthonormality: typed angles and float32 stay below 1e-6."""


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
    """Rule for keeping connected pieces of the selection: `keep` of [segment]."""
    prompts: Mapping[str, ViewPrompt] | None = None
    """Points and rectangles in photos of the source, by the photo's name: `prompts` of [segment]."""
    light: Light | None = None
    """The light set by hand; None: it is estimated."""
    weights: LayerWeights = field(default_factory=LayerWeights)
    """Strength of each layer of the light transfer."""
    harmonizer: str | None = None
    """Name of the harmonisation method."""

    def with_object(self, index: int, item: ObjectPlacement) -> "EditState":
        """Return the state with one object replaced."""
        assert self.objects is not None
        return replace(self, objects=(*self.objects[:index], item, *self.objects[index + 1 :]))


def check_state(state: EditState) -> None:
    """Check all values of a state, so that the project stays readable; raise ValueError in one line."""
    for index, item in enumerate(state.objects or ()):
        _check_placement(item, f"object {index + 1}")
    if state.box is not None:
        check_numbers(state.box, "box")
        # in float32, as the box is used
        lower, upper = torch.tensor(state.box[:3]), torch.tensor(state.box[3:])
        if not bool((lower < upper).all()):
            raise ValueError(f"box: expected lower < upper, found {list(state.box[:3])} and {list(state.box[3:])}")
    _check_choice(state.mask_source, get_args(MaskSource), "mask_source")
    _check_choice(state.keep, get_args(Keep), "keep")
    _check_choice(state.harmonizer, tuple(HARMONIZERS), "image model")
    for name, value in asdict(state.weights).items():
        _check_number(value, name, _STOPS if name in ("exposure", "warmth") else _WEIGHTS)
    if state.light is not None:
        light_from_json(light_to_json(state.light))


def check_numbers(values: Iterable[float], where: str) -> None:
    """Check that typed or dragged numbers are in the range of coordinates, as `check_state` does."""
    for value in values:
        _check_number(value, where, _COORDINATES)


def check_height_cm(value: float) -> None:
    """Check a typed height in centimetres, as `check_state` does."""
    _check_number(value, "height in cm", _HEIGHTS_CM)


def _check_placement(item: ObjectPlacement, where: str) -> None:
    move = item.target_from_object
    _check_number(move.scale, f"{where}: scale", _SCALES)
    rotation = move.rotation.double()
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    # a comparison with NaN is false
    if not (error < _ORTHONORMAL and float(torch.linalg.det(rotation)) > 0):
        raise ValueError(f"{where}: expected a rotation, found {move.rotation.tolist()}")
    for value in move.translation.tolist():
        _check_number(value, f"{where}: position", _COORDINATES)


def _check_choice(value: object, among: Sequence[str], name: str) -> None:
    if value is not None and value not in among:
        raise ValueError(f"{name}: expected one of {', '.join(among)}; found {value!r:.60}")


def _check_number(value: float, where: str, bounds: tuple[float, float]) -> None:
    # NaN fails the comparison
    if not bounds[0] <= value <= bounds[1]:
        raise ValueError(f"{where}: expected a number from {bounds[0]:g} to {bounds[1]:g}, found {value!r:.60}")
