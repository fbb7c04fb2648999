"""A light in words, for the report of a transfer and for the command line."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.light import Light

_UNCERTAIN_DEG = 15.0  # uncertainty above which a direction is called uncertain; set by hand
_WEAK, _STRONG = 0.25, 0.6  # shares of one source in the light on a plane that faces it: mostly even and strong light


def describe_light(light: Light, up: Float[Tensor, "3"]) -> str:
    """Describe a light in one line: its three brightest sources, and how much of the surroundings was photographed.

    An example is "strong light from the sun 62 degrees high (71% of the light on what faces it), a window 20 degrees
    high (9%; its direction is uncertain); 38% of what is overhead was not photographed".

    Args:
        light: The light.
        up: Unit, in the light's frame.
    """
    named, strongest = [], 0.0
    for source in light.sources[:3]:
        direction = torch.tensor(source.direction)
        height = math.degrees(math.asin(max(-1.0, min(1.0, float(direction @ up)))))
        share = sum(source.irradiance) / float(light.irradiance(direction[None]).sum())
        strongest = max(strongest, share)
        doubt = "; its direction is uncertain" if source.uncertainty_deg > _UNCERTAIN_DEG else ""
        faces = "" if named else " of the light on what faces it"
        article = "the" if source.name.startswith("sun") and " or " not in source.name else "a"
        named.append(f"{article} {source.name} {height:.0f} degrees high ({share:.0%}{faces}{doubt})")
    lead = "mostly even light, some" if strongest < _WEAK else "light" if strongest < _STRONG else "strong light"
    parts = [f"{lead} from {', '.join(named)}" if named else "even light without a clear source"]
    if light.unseen_up > 0.05:
        parts.append(f"{100 * light.unseen_up:.0f}% of what is overhead was not photographed")
    return "; ".join([*parts, f"{100 * light.coverage:.0f}% of the surroundings were photographed"])
