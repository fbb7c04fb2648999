"""The value `Light`: a few sources and smooth ambient light at one place, with its confidence and its text form."""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.runtime.notebook import draw_in_notebook

_FORMAT = "splatgraft light 1"
_AMBIENT_DEGREE = 2  # of the spherical harmonics
_AMBIENT_COUNT = (_AMBIENT_DEGREE + 1) ** 2
_UNCERTAINTY_BLUR = 0.5
"""Share of a direction's uncertainty that blurs shadows. Measured: it has the smallest error over rendered scenes; the
whole uncertainty makes shadows of a correct direction too pale."""
_MIN_AMBIENT = 1e-3  # lower bound of irradiance over the largest constant coefficient; the expansion may be negative

_SOURCE_NUMBERS = {
    "angular_radius_deg": (0.0, 90.0),
    "uncertainty_deg": (0.0, 90.0),
    "confidence": (0.0, 1.0),
    "blockers_within": (0.0, math.inf),
    "distance": (1e-4, math.inf),  # the smallest number above 0 with four decimals, as written
}
"""Scalar fields of a source with their bounds; a light.json leaves out infinite values."""


@dataclass(frozen=True)
class LightSource:
    """One bright, round light."""

    direction: tuple[float, float, float]
    """Unit vector from the place towards the light, world frame."""
    irradiance: tuple[float, float, float]
    """Linear rgb on a plane that faces the light; a white sky of radiance 1 gives pi."""
    angular_radius_deg: float = 3.0
    """Angular radius, degrees; the sun's is 0.27."""
    uncertainty_deg: float = 0.0
    """Standard error of `direction`, degrees; shadows are softened by it."""
    confidence: float = 1.0
    """Probability that the light exists, in [0, 1]; scales its shadow."""
    name: str = "light"
    """Name in reports, such as "sun", "window" or, if either is possible, "sun or window"."""
    blockers_within: float = math.inf
    """Maximum distance of occluders that block the light, world units; a window's pane lies beyond it."""
    distance: float = math.inf
    """Distance from the middle of the lit object, world units, above 0; infinite for the sun. A near light's shadows
    diverge and its irradiance falls off."""

    @property
    def softness(self) -> float:
        """Radius of the cone over which the shadow is blurred, radians; it includes half of the uncertainty."""
        return math.hypot(math.radians(self.angular_radius_deg), _UNCERTAINTY_BLUR * math.radians(self.uncertainty_deg))

    @property
    def luminance(self) -> float:
        """Rec. 709 luminance of `irradiance`."""
        r, g, b = self.irradiance
        return 0.2126 * r + 0.7152 * g + 0.0722 * b


@dataclass(frozen=True)
class Light:
    """The light at one place, world frame, linear rgb."""

    sources: tuple[LightSource, ...]
    """Sources, brightest first; empty under an even sky."""
    ambient: Float[Tensor, "9 3"]
    """Radiance of all other light, coefficients of spherical harmonics of degree 2."""
    coverage: float = 1.0
    """Share of the directions around the place that were captured, in [0, 1]."""
    unseen_up: float = 0.0
    """Share of the directions within 60 degrees of up that were not captured, in [0, 1]."""

    def __repr__(self) -> str:
        names = ", ".join(source.name for source in self.sources) or "none"
        return f"Light(sources: {names}; {self.coverage:.0%} of the directions captured)"

    _repr_png_ = draw_in_notebook

    def ambient_radiance(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the linear rgb radiance of the ambient light from unit `directions`, at least 0."""
        values = spherical_harmonics.basis(directions, _AMBIENT_DEGREE) @ self.ambient.to(directions)
        return values.clamp_min(0)

    def irradiance(self, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Compute the linear rgb irradiance on unshadowed planes (Ramamoorthi and Hanrahan 2001, Eq. 11).

        Args:
            normals: Unit.
        """
        bands = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5).to(normals)
        total = spherical_harmonics.basis(normals, _AMBIENT_DEGREE) @ (bands[:, None] * self.ambient.to(normals))
        total = total.clamp_min(_MIN_AMBIENT * float(self.ambient[0].abs().max()) + 1e-6)
        for source in self.sources:
            cosine = (normals @ torch.tensor(source.direction).to(normals)).clamp_min(0)
            total = total + cosine[:, None] * torch.tensor(source.irradiance).to(normals)
        return total

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> "Light":
        """Return the light with all directions rotated by `rotation`."""
        turned = [(rotation.double() @ torch.tensor(s.direction, dtype=torch.float64)).tolist() for s in self.sources]
        sources = tuple(replace(s, direction=(d[0], d[1], d[2])) for s, d in zip(self.sources, turned, strict=True))
        ambient = spherical_harmonics.rotate(self.ambient[None], rotation)[0]
        return replace(self, sources=sources, ambient=ambient)


def angular_radius_deg(solid_angle: float) -> float:
    """Return the angular radius, degrees, of a round light of `solid_angle` (steradians)."""
    return math.degrees(math.acos(max(-1.0, 1 - solid_angle / (2 * math.pi))))


def fit_ambient(radiance: Float[Tensor, "3"]) -> Float[Tensor, "9 3"]:
    """Return the coefficients of uniform ambient light of linear rgb `radiance`."""
    out = torch.zeros(_AMBIENT_COUNT, 3)
    out[0] = radiance / spherical_harmonics.C0
    return out


def light_to_json(light: Light, *, world_from_capture: Float[Tensor, "3 3"] | None = None) -> str:
    """Write the text of a light.json, which can be changed by hand and read by `light_from_json`.

    Args:
        light: In the axes of a capture.
        world_from_capture: Rotation into the axes of the text, which then contains it; None keeps the capture's axes.
    """
    axes = {}
    if world_from_capture is not None:
        light, axes = light.rotated(world_from_capture), {"world_from_capture": world_from_capture.tolist()}
    sources = []
    for source in light.sources:
        record = {"name": source.name}
        record |= {key: [round(float(v), 6) for v in getattr(source, key)] for key in ("direction", "irradiance")}
        numbers = {key: round(getattr(source, key), 4) for key in _SOURCE_NUMBERS}
        sources.append(record | {key: value for key, value in numbers.items() if math.isfinite(value)})
    record = {
        "format": _FORMAT,
        **axes,
        "sources": sources,
        "ambient_sh": [[round(v, 6) for v in row] for row in light.ambient.tolist()],
        "coverage": round(light.coverage, 4),
        "unseen_up": round(light.unseen_up, 4),
    }
    return json.dumps(record, indent=1) + "\n"


def light_from_json(text: str, *, name: str = "light.json") -> Light:
    """Read a light from the text of a light.json.

    Args:
        text: Text of `light_to_json`, perhaps changed by hand.
        name: File name in error messages.

    Returns:
        The light in the axes of the capture, directions normalised.

    Raises:
        ValueError: The text is not JSON, a key is missing or unknown, or a value is out of its range.
    """
    try:
        record = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{name}: expected JSON, found {error}") from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ValueError(f'{name}: expected "format": "{_FORMAT}", found {found!r}')
    unknown = sorted(set(record) - {"format", "world_from_capture", "sources", "ambient_sh", "coverage", "unseen_up"})
    if unknown:
        raise ValueError(f"{name}: expected sources, ambient_sh, coverage and unseen_up, found {unknown[0]!r}")
    if not isinstance(record.get("sources"), list):
        raise ValueError(f"{name}: expected a list under sources, found {record.get('sources')!r:.60}")
    ambient = record.get("ambient_sh")
    if not isinstance(ambient, list) or len(ambient) != _AMBIENT_COUNT:
        raise ValueError(f"{name}: expected 9 rows of rgb under ambient_sh, found {ambient!r:.60}")
    rows = [_numbers(row, 3, f"{name}: ambient_sh[{i}]", (-1e6, 1e6)) for i, row in enumerate(ambient)]
    found = Light(
        sources=tuple(_source(entry, f"{name}: sources[{i}]") for i, entry in enumerate(record["sources"])),
        ambient=torch.tensor(rows),
        coverage=_numbers([record.get("coverage", 1.0)], 1, f"{name}: coverage", (0.0, 1.0))[0],
        unseen_up=_numbers([record.get("unseen_up", 0.0)], 1, f"{name}: unseen_up", (0.0, 1.0))[0],
    )
    return found.rotated(_capture_from_world(record, name)) if "world_from_capture" in record else found


def _capture_from_world(record: dict[str, Any], name: str) -> Float[Tensor, "3 3"]:
    where, given = f"{name}: world_from_capture", record["world_from_capture"]
    if not isinstance(given, list) or len(given) != 3:
        raise ValueError(f"{where}: expected 3 rows of a rotation, found {given!r:.60}")
    rotation = torch.tensor([_numbers(row, 3, f"{where}[{i}]", (-1.0, 1.0)) for i, row in enumerate(given)])
    is_orthonormal = float((rotation @ rotation.T - torch.eye(3)).abs().max()) <= 1e-4
    if not is_orthonormal or float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"{where}: expected a rotation that is orthonormal with determinant 1, found {given!r:.60}")
    return rotation.T


def _source(entry: object, where: str) -> LightSource:
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected an object with direction and irradiance, found {entry!r:.60}")
    known = {"name", "direction", "irradiance", *_SOURCE_NUMBERS}
    unknown = sorted(set(entry) - known)
    if unknown:
        raise ValueError(f"{where}: expected only {', '.join(sorted(known))}, found {unknown[0]!r}")
    direction = _numbers(entry.get("direction"), 3, f"{where}.direction", (-1e6, 1e6))
    length = math.sqrt(sum(v * v for v in direction))
    if length < 1e-6:
        raise ValueError(f"{where}.direction: expected a vector longer than zero, found {direction}")
    r, g, b = _numbers(entry.get("irradiance"), 3, f"{where}.irradiance", (0.0, 1e6))
    name = entry.get("name", "light")
    if not isinstance(name, str):
        raise ValueError(f"{where}.name: expected a text, found {name!r:.60}")
    numbers = {
        key: _numbers([entry[key]], 1, f"{where}.{key}", bounds)[0]
        for key, bounds in _SOURCE_NUMBERS.items()
        if key in entry
    }
    x, y, z = (v / length for v in direction)
    return LightSource((x, y, z), (r, g, b), name=name, **numbers)


def _numbers(values: object, count: int, where: str, bounds: tuple[float, float]) -> list[float]:
    expected = f"{count} number{'s' if count > 1 else ''} from {bounds[0]:g} to {bounds[1]:g}"
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{where}: expected {expected}, found {values!r:.60}")
    for value in values:
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not good or not bounds[0] <= value <= bounds[1]:
            raise ValueError(f"{where}: expected {expected}, found {value!r:.60}")
    return [float(v) for v in values]


def light_confidence(light: Light) -> float:
    """Compute the share of the light, in [0, 1], that was captured with a certain direction.

    A source counts by its confidence times exp(-(uncertainty / 20 degrees)^2); ambient light counts fully. The share is
    then multiplied by the coverage of the surroundings. The 20 degrees are set by hand.
    """
    ambient = math.pi * float(light.ambient[0].mean()) * spherical_harmonics.C0
    total, certain = ambient, ambient
    for source in light.sources:
        total += source.luminance
        certain += source.luminance * source.confidence * math.exp(-((source.uncertainty_deg / 20.0) ** 2))
    return light.coverage * certain / total if total > 0 else 0.0
