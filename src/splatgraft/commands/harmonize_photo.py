"""The command `harmonize photo`: harmonise one composite picture by its mask, without a scene."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import subcommand

from splatgraft.core.images import read_mask, read_rgb, write_image
from splatgraft.harmonization import EditOptions, FluxOptions, HarmonizerContext, HarmonizerInputs, make_harmonizer
from splatgraft.project.step import Device, Positional, choose_device
from splatgraft.runtime.console import Console


@dataclass(frozen=True)
class HarmonizePhoto:
    """Make the light of an object agree with the picture that it was pasted into."""

    composite: Positional
    """The picture with the object pasted in."""
    mask: Positional
    """Mask of the picture, white on the object."""
    out: Path = Path("harmonized.png")
    """The picture to write."""
    background: Path | None = None
    """The picture without the object, for models that take it instead of the mask."""
    method: Annotated[FluxOptions, subcommand("flux")] | Annotated[EditOptions, subcommand("edit")] = field(
        default_factory=FluxOptions
    )
    """The image model."""
    device: Device = "auto"
    """Device to compute on."""

    def execute(self, console: Console) -> int:
        """Write the picture."""
        composite, mask = read_rgb(self.composite), read_mask(self.mask)
        background = composite if self.background is None else read_rgb(self.background)
        for path, picture in ((self.mask, mask), (self.background, background)):
            if picture.shape[:2] != composite.shape[:2]:
                wanted, found = (f"{one.shape[1]}x{one.shape[0]}" for one in (composite, picture))
                raise ValueError(f"{path}: expected {wanted} pixels as {self.composite}, found {found}")
        if not bool((mask > 0.5).any()):
            raise ValueError(f"{self.mask}: expected a mask that is white where the object is, found a black one")
        device = choose_device(self.device, console)
        harmonizer = make_harmonizer(
            self.method, HarmonizerContext(device=device, pixels=mask.numel(), say=console.say)
        )
        variant = getattr(getattr(harmonizer, "network", None), "variant", "")
        if self.background is None and variant == "image-background":
            raise ValueError("--background: expected the picture without the object for this model, found none")
        nothing = torch.zeros(mask.shape)
        view = HarmonizerInputs(composite, background, mask, nothing, composite)
        write_image(self.out, harmonizer.harmonize(view).cpu().clamp(0, 1))
        console.result(self.out)
        return 0


COMMAND = HarmonizePhoto
