"""The command `segment`: a scene and 2D masks become the object's Gaussians and the scene without them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.folders.capture_files import capture_inputs
from splatgraft.folders.object_masks import MaskSource, cut_masks, network_masks, read_masks, with_mask_folder
from splatgraft.folders.selection_file import write_selection
from splatgraft.formats import read_capture, read_gaussians, write_gaussians
from splatgraft.formats.corrections import read_corrections
from splatgraft.project.layout import OBJECT_FILE, SELECTION_FILE, SURROUNDINGS_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.segmentation import (
    Box,
    Keep,
    LiftOptions,
    SelectOptions,
    SolidifyOptions,
    apply_corrections,
    lift_masks,
    select_object,
    solidify_object,
)


@dataclass(frozen=True)
class Segment:
    """Lift 2D masks of the object to the Gaussians of a scene."""

    scene: Path
    """The reconstruction, a .ply."""
    capture: Path
    """The posed images that it was made of."""
    out: Path = Path("object")
    """Folder for object.ply, surroundings.ply (the scene without it), selection.npy, feature.npy; masks/ where made."""
    mask_source: MaskSource = "files"
    """files: masks/ beside the images, or --masks. grabcut: from a box around the object. birefnet: from a network.
    box: no masks, all Gaussians whose centre is in the box (of a scene that is the object alone: a box around all)."""
    masks: Path | None = None
    """Folder of masks named like the images, white where the object is; views without one are left out."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z, then greatest, around the object in the source's world; grabcut guesses it where not given."""
    birefnet: Path | None = None
    """An .onnx file of BiRefNet; fetched once from its hub where not given."""
    threshold: float = 0.75
    """Least share of a Gaussian that the masks must give to the object."""
    keep: Keep = "substantial"
    """Which separate pieces stay: those with at least a twentieth of the largest one's opacity, the largest, or all."""
    corrections: Path | None = None
    """A .npy with one int8 per Gaussian of the scene, as the editor writes it: 1 adds it to the object, -1 removes."""
    solidify: int = SolidifyOptions.iterations
    """Optimisation steps that make the object opaque when it is rendered alone; 0 keeps its Gaussians unchanged."""
    device: Device = "auto"
    """Where to compute."""
    options: LiftOptions = field(default_factory=LiftOptions)

    def inputs(self) -> Inputs:
        """The scene, the capture and the masks."""
        capture = read_capture(self.capture)
        if self.mask_source == "files":
            capture = with_mask_folder(capture, self.masks, self.capture)
        files = capture_inputs(self.capture, capture, masks=self.mask_source == "files")
        weights = () if self.birefnet is None else (self.birefnet,)
        by_hand = {} if self.corrections is None else {"corrections": (self.corrections,)}
        return {"scene": (self.scene,), "weights": weights, **by_hand, **files}

    def write(self, folder: Path, context: Context) -> None:
        """Make the object."""
        device = choose_device(self.device, context.console)
        scene = read_gaussians(self.scene).to(device)
        box = None if self.box is None else Box(torch.tensor(self.box[:3]), torch.tensor(self.box[3:]))
        views, feature = None, _in_box(scene, box) if self.mask_source == "box" else None
        if feature is None:
            views = self._masked_views(scene, folder, box, context)
            cameras = views.cameras.to(device)
            feature = lift_masks(scene, cameras, read_masks(views), self.options, progress=context.progress)
        selection = select_object(scene, feature, SelectOptions(threshold=self.threshold, box=box, keep=self.keep))
        if self.corrections is not None:
            selection = apply_corrections(selection, read_corrections(self.corrections))
        context.console.say(f"object: {int(selection.sum()):,} of {scene.count:,} Gaussians")
        chosen = scene.select(selection)
        if self.solidify and views is not None:
            masks = read_masks(views)
            photographs = LazySequence(len(views), lambda index: (views.image(index), masks[index]))
            options, cameras = SolidifyOptions(iterations=self.solidify), views.cameras.to(device)
            chosen = solidify_object(scene, selection, cameras, photographs, options=options, progress=context.progress)
        write_gaussians(folder / OBJECT_FILE, chosen.to("cpu"))
        write_gaussians(folder / SURROUNDINGS_FILE, scene.select(~selection).to("cpu"))
        write_selection(folder / SELECTION_FILE, selection)
        with atomic_write(folder / "feature.npy") as stream:
            np.save(stream, feature.cpu().numpy())

    def _masked_views(self, scene: Gaussians, folder: Path, box: Box | None, context: Context) -> PosedImages:
        capture = read_capture(self.capture)
        if self.mask_source == "files":
            return with_mask_folder(capture, self.masks, self.capture)
        made = folder / "masks"
        if self.mask_source == "grabcut":
            return cut_masks(capture, scene, box=box, folder=made, progress=context.progress)
        return network_masks(capture, weights=self.birefnet, folder=made, progress=context.progress)


def _in_box(scene: Gaussians, box: Box | None) -> Float[Tensor, "n"]:
    if box is None:
        raise ValueError("--mask-source box: expected --box beside it, found none")
    return box.contains(scene.means).float()


COMMAND = Segment
