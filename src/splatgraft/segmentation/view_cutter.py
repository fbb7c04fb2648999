"""The interface of an algorithm that cuts the object out of one picture, and what it is told about the object."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.prompts import ViewPrompt


@dataclass(frozen=True)
class Evidence:
    """What is known of the object in one picture before it is cut."""

    lifted: Float[Tensor, "h w"]
    """Share of each pixel that belongs to the object by the 3D selection, in [0, 1]; not 0 everywhere."""
    prompt: ViewPrompt = field(default_factory=ViewPrompt)
    """What the user says, pixels of the picture."""


@runtime_checkable
class ViewCutter(Protocol):
    """Cuts the object out of one picture."""

    def cut(self, image: Float[Tensor, "h w 3"], evidence: Evidence) -> Float[Tensor, "h w"]:
        """The object's mask, 0 or 1.

        Args:
            image: sRGB in [0, 1].
            evidence: Of the object in this picture.
        """
        ...
