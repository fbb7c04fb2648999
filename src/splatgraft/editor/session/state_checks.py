"""Limits of the edits: each state is checked before it is saved and after it is read, so that none makes a project
unreadable."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import cast, get_args

import torch
from torch import Tensor

from splatgraft.editor.session.edit_state import EditState
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.harmonization import HARMONIZERS
from splatgraft.relighting import LayerWeights, Light, light_from_json, light_to_json
from splatgraft.segmentation import Keep

MIN_SCALE, MAX_SCALE = 1e-6, 1e6
"""Smallest and largest scale of an object: beyond, covariances leave the range of float32."""
MAX_COORDINATE = 1e6
"""Largest absolute coordinate, world units: beyond, float32 resolves less than a tenth of a unit."""
MIN_HEIGHT_CM, MAX_HEIGHT_CM = 1e-3, 1e7
"""Smallest and largest height that can be typed: a hundredth of a millimetre, and a hundred kilometres."""
MASK_SOURCES = ("auto", "files", "grabcut", "sam2", "birefnet", "box")
"""Values of `mask_source` of [segment]."""
MAX_WEIGHT = 100.0
"""Largest weight of a layer of the light transfer."""
MAX_STOPS = 16.0
"""Largest exposure of the objects, up or down, stops."""
_ORTHONORMAL = 1e-3
"""Largest deviation of a rotation from orthonormality: typed angles and float32 stay below 1e-6."""


def check_state(state: EditState) -> None:
    """Check all values of a state.

    Raises:
        ValueError: If a value is of the wrong type, not finite or out of its range; one line.
    """
    for index, item in enumerate(state.objects or ()):
        check_placement(item, f"object {index + 1}")
    if state.erased is not None:
        _check_array(state.erased, torch.bool, "erased")
    if state.corrections is not None:
        _check_array(state.corrections, torch.int8, "corrections")
    if state.box is not None:
        _check_box(state.box)
    for name, prompt in (state.prompts or {}).items():
        check_numbers((*prompt.inside.flatten().tolist(), *prompt.outside.flatten().tolist()), f"points in {name}")
    _check_choice(state.mask_source, MASK_SOURCES, "mask_source")
    _check_choice(state.keep, get_args(Keep), "keep")
    _check_choice(state.harmonizer, tuple(HARMONIZERS), "image model")
    _check_weights(state.weights)
    _check_light(state.light)


def check_placement(item: ObjectPlacement, where: str) -> None:
    """Check the numbers of a placement.

    Raises:
        ValueError: As `check_state`.
    """
    move = item.target_from_object
    _check_number(move.scale, f"{where}: scale", (MIN_SCALE, MAX_SCALE))
    rotation = move.rotation
    is_rotation = isinstance(rotation, Tensor) and rotation.shape == (3, 3) and rotation.is_floating_point()
    if is_rotation:
        rotation = rotation.double()
        error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
        # a comparison with NaN is false
        is_rotation = error < _ORTHONORMAL and float(torch.linalg.det(rotation)) > 0
    if not is_rotation:
        raise ValueError(f"{where}: expected a rotation, found {_short(move.rotation)}")
    if not isinstance(move.translation, Tensor) or move.translation.shape != (3,):
        raise ValueError(f"{where}: expected three numbers as position, found {_short(move.translation)}")
    for value in move.translation.tolist():
        _check_number(value, f"{where}: position", (-MAX_COORDINATE, MAX_COORDINATE))


def check_numbers(values: Iterable[object], where: str) -> None:
    """Check that typed or dragged numbers are finite and not above the largest coordinate.

    Raises:
        ValueError: As `check_state`.
    """
    for value in values:
        _check_number(value, where, (-MAX_COORDINATE, MAX_COORDINATE))


def check_height_cm(value: object) -> None:
    """Check a typed height in centimetres.

    Raises:
        ValueError: As `check_state`.
    """
    _check_number(value, "height in cm", (MIN_HEIGHT_CM, MAX_HEIGHT_CM))


def _check_box(box: Sequence[float]) -> None:
    if not isinstance(box, tuple) or len(box) != 6:
        raise ValueError(f"box: expected six numbers, found {_short(box)}")
    check_numbers(box, "box")
    # in float32, in which the box is used
    lower, upper = torch.tensor(box[:3]), torch.tensor(box[3:])
    if not bool((lower < upper).all()):
        raise ValueError(f"box: expected lower < upper, found {list(box[:3])} and {list(box[3:])}")


def _check_weights(weights: LayerWeights) -> None:
    for name, value in asdict(weights).items():
        _check_number(value, name, (-MAX_STOPS, MAX_STOPS) if name == "exposure" else (0.0, MAX_WEIGHT))


def _check_light(light: Light | None) -> None:
    if light is not None:
        light_from_json(light_to_json(light))


def _check_array(array: Tensor, dtype: torch.dtype, name: str) -> None:
    if not isinstance(array, Tensor) or array.dtype != dtype or array.ndim != 1:
        raise ValueError(f"{name}: expected one {dtype} per Gaussian, found {_short(array)}")


def _check_choice(value: object, among: Sequence[str], name: str) -> None:
    if value is not None and value not in among:
        raise ValueError(f"{name}: expected one of {', '.join(among)}; found {_short(value)}")


def _check_number(value: object, where: str, bounds: tuple[float, float]) -> None:
    # int beyond the range of float is out of every range here; NaN fails the comparison
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not bounds[0] <= cast("float", value) <= bounds[1]:
        raise ValueError(f"{where}: expected a number from {bounds[0]:g} to {bounds[1]:g}, found {_short(value)}")


def _short(value: object) -> str:
    if isinstance(value, Tensor):
        return f"{value.tolist()!r:.60}" if value.numel() < 20 else f"a tensor {tuple(value.shape)}"
    return f"{value!r:.60}"
