"""The value `Light`: the light at a place as a few sources and smooth ambient light; its confidence, and its text form
light.json.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics

FORMAT = "splatgraft light 1"
_AMBIENT_DEGREE = 2
_AMBIENT_COUNT = 9
_UNCERTAINTY_BLUR = 0.5
"""Share of a direction's uncertainty that blurs shadows; measured: least error in rendered scenes. All of it makes
shadows of a right direction too pale."""
_UNCERTAIN_DEG = 15.0  # uncertainty of a direction from which on a report says so; set by hand
_MIN_AMBIENT = 1e-3
"""Share of the largest ambient coefficient below which ambient irradiance does not fall: expansions may be negative."""

_MIN_DISTANCE = 1e-4  # world units; minimum distance of a source in a light.json, whose numbers have four decimals
_SOURCE_NUMBERS = {
    "angular_radius_deg": (0.0, 90.0),
    "uncertainty_deg": (0.0, 90.0),
    "confidence": (0.0, 1.0),
    "blockers_within": (0.0, math.inf),
    "distance": (_MIN_DISTANCE, math.inf),
}
"""Fields of a source that are one number, and its bounds; a light.json leaves out what is infinite."""

_RIGID = 1e-4  # largest entry of R R^T - I of a rotation in a light.json

_WEAK, _STRONG = 0.25, 0.6
"""Shares of a source in the light on what faces it, below and above which words say so."""


@dataclass(frozen=True)
class LightSource:
    """One bright, round light."""

    direction: tuple[float, float, float]
    """Unit vector from the place towards the light, world frame."""
    irradiance: tuple[float, float, float]
    """Linear rgb on a plane that faces the light, in units in which a white sky of radiance 1 gives pi."""
    angular_radius_deg: float = 3.0
    """Half the angle that the light subtends, degrees; the sun's is 0.27."""
    uncertainty_deg: float = 0.0
    """Standard error of `direction`, degrees; shadows are softened by it."""
    confidence: float = 1.0
    """Probability that this light exists, in [0, 1]; scales its shadow."""
    name: str = "light"
    """Shown in reports: sun, window, lamp, or what of them it may be."""
    blockers_within: float = math.inf
    """World units; occluders farther away do not block it, such as the window that it comes through."""
    distance: float = math.inf
    """World units from the middle of the lit object, above 0; infinite for the sun. Shadows spread and light falls off
    from where it stands."""

    @property
    def softness(self) -> float:
        """Radius of the cone over which its shadow is blurred, radians: its size and half of its uncertainty."""
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
    """Brightest first; empty under an even sky."""
    ambient: Float[Tensor, "9 3"]
    """Radiance from everything else, spherical harmonics of degree 2."""
    coverage: float = 1.0
    """Share of the directions around the place that were captured, in [0, 1]."""
    unseen_up: float = 0.0
    """Share of the directions within 60 degrees of up that were not captured, in [0, 1]."""

    def ambient_radiance(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear rgb radiance of the ambient light from unit `directions`, at least 0."""
        values = spherical_harmonics.basis(directions, _AMBIENT_DEGREE) @ self.ambient.to(directions)
        return values.clamp_min(0)

    def irradiance(self, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear rgb irradiance on unshadowed planes with unit `normals` (Ramamoorthi and Hanrahan 2001, Eq. 11)."""
        bands = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5).to(normals)
        total = spherical_harmonics.basis(normals, _AMBIENT_DEGREE) @ (bands[:, None] * self.ambient.to(normals))
        total = total.clamp_min(_MIN_AMBIENT * float(self.ambient[0].abs().max()) + 1e-6)
        for source in self.sources:
            cosine = (normals @ torch.tensor(source.direction).to(normals)).clamp_min(0)
            total = total + cosine[:, None] * torch.tensor(source.irradiance).to(normals)
        return total

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> "Light":
        """The same light in a frame that is rotated by `rotation`."""
        turned = [(rotation.double() @ torch.tensor(s.direction, dtype=torch.float64)).tolist() for s in self.sources]
        sources = tuple(replace(s, direction=(d[0], d[1], d[2])) for s, d in zip(self.sources, turned, strict=True))
        ambient = spherical_harmonics.rotate(self.ambient[None], rotation)[0]
        return replace(self, sources=sources, ambient=ambient)

    def describe(self, up: Float[Tensor, "3"]) -> str:
        """One line for a report, such as 'strong light from the sun 62 degrees high (71% of the light on what faces
        it), a window 20 degrees high (9%; its direction is uncertain); 38% of what is overhead was not photographed'.
        """
        named, strongest = [], 0.0
        for source in self.sources[:3]:
            direction = torch.tensor(source.direction)
            height = math.degrees(math.asin(max(-1.0, min(1.0, float(direction @ up)))))
            share = sum(source.irradiance) / float(self.irradiance(direction[None]).sum())
            strongest = max(strongest, share)
            doubt = "; its direction is uncertain" if source.uncertainty_deg > _UNCERTAIN_DEG else ""
            faces = "" if named else " of the light on what faces it"
            which = "the" if source.name.startswith("sun") and " or " not in source.name else "a"
            named.append(f"{which} {source.name} {height:.0f} degrees high ({share:.0%}{faces}{doubt})")
        lead = "mostly even light, some" if strongest < _WEAK else "light" if strongest < _STRONG else "strong light"
        parts = [f"{lead} from {', '.join(named)}" if named else "even light without a clear source"]
        if self.unseen_up > 0.05:
            parts.append(f"{100 * self.unseen_up:.0f}% of what is overhead was not photographed")
        return "; ".join([*parts, f"{100 * self.coverage:.0f}% of the surroundings were photographed"])


def angular_radius_deg(solid_angle: float) -> float:
    """Half the angle, in degrees, that a round light of `solid_angle` (steradians) subtends."""
    return math.degrees(math.acos(max(-1.0, 1 - solid_angle / (2 * math.pi))))


def fit_ambient(radiance: Float[Tensor, "3"]) -> Float[Tensor, "9 3"]:
    """Coefficients of uniform ambient light of linear rgb `radiance`."""
    out = torch.zeros(_AMBIENT_COUNT, 3)
    out[0] = radiance / spherical_harmonics.C0
    return out


def light_to_json(light: Light, *, world_from_capture: Float[Tensor, "3 3"] | None = None) -> str:
    """The text of a light.json, which can be changed by hand and read with `light_from_json`.

    Args:
        light: In the axes of a capture.
        world_from_capture: A rotation into other axes, in which the text has the light, and which it then names.
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
        "format": FORMAT,
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
        text: What `light_to_json` gives, perhaps changed by hand.
        name: The file's name in error messages.

    Returns:
        The light in the axes of the capture, directions normalised.

    Raises:
        ValueError: The text is no JSON, a key is missing or unknown, or a value is out of its range.
    """
    try:
        record = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{name}: expected JSON, found {error}") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ValueError(f'{name}: expected "format": "{FORMAT}", found {found!r}')
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
    if not float((rotation @ rotation.T - torch.eye(3)).abs().max()) <= _RIGID or float(torch.linalg.det(rotation)) < 0:
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


_C0 = 0.28209479
"""The harmonics' first band; rounded, and kept so: `core.spherical_harmonics.C0` would change written priors."""
_UNCERTAIN_DEG = 20.0  # degrees of direction uncertainty at which a source counts exp(-1); set by hand


def light_confidence(light: Light) -> float:
    """Share of the light, in [0, 1], that was captured and whose direction is certain.

    A source counts by exp(-(uncertainty / 20 degrees)^2) times its confidence, ambient light fully; the sum is scaled
    by the coverage of the surroundings.
    """
    ambient = math.pi * float(light.ambient[0].mean()) * _C0
    total, certain = ambient, ambient
    for source in light.sources:
        total += source.luminance
        certain += source.luminance * source.confidence * math.exp(-((source.uncertainty_deg / _UNCERTAIN_DEG) ** 2))
    return light.coverage * certain / total if total > 0 else 0.0
