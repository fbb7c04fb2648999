"""Compose: objects are placed in a target scene. Knows nothing about light, images or files."""

from splatgraft.compose.assemble import compose
from splatgraft.composite import Composite, PlacedObject

__all__ = ["Composite", "PlacedObject", "compose"]
