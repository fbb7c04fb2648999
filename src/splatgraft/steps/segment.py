"""The command `segment`: split a scene into the object's Gaussians and the rest, by 2D masks."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.composition import Coverage
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import WIDE_GAP_DEG, estimate_up, widest_gap
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import resize, write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.folders.capture_files import capture_inputs, read_view_gains
from splatgraft.folders.object_masks import (
    MaskedViews,
    MaskSource,
    masked_views,
    with_mask_folder,
    write_mask_sheet,
    write_masks,
)
from splatgraft.folders.picture_points import prompts_by_view
from splatgraft.formats import has_known_surface, read_capture, read_gaussians, write_gaussians
from splatgraft.project.gaussian_flags import read_corrections, write_flags
from splatgraft.project.layout import COVERAGE_FILE, IS_GUESSED_FILE, OBJECT_FILE, SELECTION_FILE, SURROUNDINGS_FILE
from splatgraft.project.prompts import read_prompts
from splatgraft.project.step import Context, Device, Inputs, choose_device, plain_options
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.note import Note
from splatgraft.segmentation import (
    CUT_SIDE_PX,
    MIN_AGREEMENT,
    Agreement,
    Box,
    CutRequest,
    Keep,
    LiftOptions,
    SelectOptions,
    SolidifyOptions,
    ViewCutter,
    apply_corrections,
    close_unseen_side,
    cut_capture,
    grabcut_mask,
    lift_masks,
    load_sam2,
    measure_agreement,
    network_masks,
    part_shares,
    select_object,
    solidify_object,
)

SHEET_FILE = "views.png"
AGREEMENT_FILE = "agreement.json"
SOLID_SIDE_PX = 960
"""Longest side of the photos that the object is fitted to; time and memory grow with their area."""
_LIFTED_SIDE_PX = 640  # longest side of the masks that are lifted; full masks change one Gaussian in a thousand
_PICTURED = 8  # photographs on the sheet
_SEPARATE = 0.1  # share of the object's opacity; warn if a separate part has more
_MUCH_GUESSED = 0.1  # share of the surface; warn if more was never photographed


@dataclass(frozen=True)
class Segment:
    """Lift 2D masks of the object to the Gaussians of a scene."""

    remedy: ClassVar[str] = (
        "put the box around the object, or paint what is missing: splatgraft edit PROJECT, step Select"
    )

    scene: Path
    """The reconstruction, a .ply."""
    capture: Path
    """The posed images that the scene was made of."""
    out: Path = Path("object")
    """Folder for object.ply, is_guessed.npy (Gaussians that close its unseen side), surroundings.ply (the scene without
    the object), selection.npy, feature.npy, agreement.json and views.png (agreement of the masks); masks/ if made."""
    mask_source: MaskSource = "auto"
    """files: masks/ beside the images, or --masks. grabcut, sam2: cut from the images, guided by the scene, --prompts
    and --box. birefnet: from a network. box: no masks, all Gaussians whose centre is in the box. whole: no masks, the
    scene is the object alone. auto: whole for a mesh; files if every image has one, else grabcut."""
    masks: Path | None = None
    """Folder of masks named like the images, white on the object; views without a mask are left out."""
    prompts: Path | None = None
    """A .toml or .json with points and rectangles on the object in two or three images, for grabcut and sam2."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Minimum x, y, z, then maximum, of a box around the object in the source's world; guessed if not given."""
    sam2_encoder: Path | None = None
    """An .onnx file of SAM 2's image encoder, for sam2."""
    sam2_decoder: Path | None = None
    """An .onnx file of SAM 2's prompt decoder, for sam2."""
    birefnet: Path | None = None
    """An .onnx file of BiRefNet; fetched once from the hub if not given."""
    threshold: float = 0.75
    """Minimum share of a Gaussian's blending weight inside the masks."""
    keep: Keep = "substantial"
    """Separate pieces to keep: those with at least a twentieth of the largest one's opacity, the largest, or all."""
    corrections: Path | None = None
    """A .npy of the editor with one int8 per Gaussian of the scene: 1 adds it to the object, -1 removes it."""
    solidify: int = SolidifyOptions.iterations
    """Steps that fit the object alone to its photographs, to make it opaque and detailed; 0 keeps its Gaussians."""
    keep_open: bool = False
    """Leave the unphotographed side of the object open; otherwise it is closed."""
    device: Device = "auto"
    """Device to compute on."""
    options: LiftOptions = field(default_factory=LiftOptions)

    def inputs(self) -> Inputs:
        """Return the scene, the capture, the masks, and the user's corrections and prompts."""
        capture = read_capture(self.capture)
        source = self._source(capture)
        if source == "files":
            capture = with_mask_folder(capture, self.masks, self.capture)
        files = capture_inputs(self.capture, capture, masks=source != "birefnet")
        weights = tuple(path for path in (self.birefnet, self.sam2_encoder, self.sam2_decoder) if path is not None)
        by_hand = {"corrections": self.corrections, "prompts": self.prompts}
        given = {name: (path,) for name, path in by_hand.items() if path is not None}
        return {"scene": (self.scene,), "weights": weights, **given, **files}

    def recorded_options(self) -> dict[str, Any]:
        """Return the options, with `auto` replaced by the source of masks that it chooses."""
        return plain_options(vars(self)) | {"mask_source": self._source(read_capture(self.capture))}

    def write(self, folder: Path, context: Context) -> None:
        """Write the object and its surroundings."""
        device = choose_device(self.device, context.console)
        scene = read_gaussians(self.scene)
        on_device = scene.to(device)
        box = None if self.box is None else Box(torch.tensor(self.box[:3]), torch.tensor(self.box[3:]))
        capture = read_capture(self.capture)
        masked, feature, keep, source = None, None, self.keep, self._source(capture)
        if source == "whole":
            feature, keep = torch.ones(scene.count), "all"
        elif source == "box":
            if box is None:
                raise ValueError("--mask-source box: expected --box beside it, found none")
            feature = box.contains(scene.means).float()
        else:
            masked = self._masked_views(capture, on_device, folder, box, context)
            # the paper's training of the feature takes full masks
            full = int(masked.views.cameras.sizes.max())
            cameras, small = _small_masks(masked, full if self.options.method == "bce" else _LIFTED_SIDE_PX)
            feature = lift_masks(on_device, cameras.to(device), small, self.options, progress=context.progress)
            if masked.region is not None:
                feature = feature * masked.region.allows(on_device.means)
            feature = feature.cpu()
        selection = select_object(scene, feature, SelectOptions(threshold=self.threshold, box=box, keep=keep))
        if self.corrections is not None:
            selection = apply_corrections(selection, read_corrections(self.corrections))
        context.console.say(f"object: {int(selection.sum()):,} of {scene.count:,} Gaussians")
        if masked is not None:
            self._compare(masked, scene, selection, folder, context)
        chosen = scene.select(selection)
        if self.solidify and masked is not None:
            views, photographs = _photographs(masked)
            gains = read_view_gains(views.image_paths)
            options = SolidifyOptions(self.solidify, threshold=self.threshold, view_gains=gains)
            cameras = views.cameras.to(device)
            chosen = solidify_object(
                on_device, selection.to(device), cameras, photographs, options=options, progress=context.progress
            ).to("cpu")
            context.console.say(f"object, made solid: {chosen.count:,} Gaussians")
        is_guessed = torch.zeros(chosen.count, dtype=torch.bool)
        if not self.keep_open and masked is not None:
            chosen, is_guessed = self._closed(chosen, masked, folder, context)
        write_gaussians(folder / OBJECT_FILE, chosen)
        write_flags(folder / IS_GUESSED_FILE, is_guessed)
        write_gaussians(folder / SURROUNDINGS_FILE, scene.select(~selection))
        write_flags(folder / SELECTION_FILE, selection)
        with atomic_write(folder / "feature.npy") as stream:
            np.save(stream, feature.numpy())

    def _source(self, capture: PosedImages) -> MaskSource:
        """Return the source of masks, with `auto` resolved."""
        if self.mask_source != "auto":
            return self.mask_source
        if has_known_surface(self.scene):
            return "whole"
        given = self.masks is not None or len(capture.with_masks()) == len(capture)
        return "files" if given and self.prompts is None else "grabcut"

    def _masked_views(
        self, capture: PosedImages, scene: Gaussians, folder: Path, box: Box | None, context: Context
    ) -> MaskedViews:
        source, made = self._source(capture), folder / "masks"
        if source == "files":
            return masked_views(with_mask_folder(capture, self.masks, self.capture))
        if source == "birefnet":
            return write_masks(made, capture, network_masks(capture, weights=self.birefnet, progress=context.progress))
        prompts = None
        if self.prompts is not None:
            prompts = prompts_by_view(capture, read_prompts(self.prompts), self.prompts)
        if self.mask_source == "auto":
            context.console.say(f"{self.capture}: not every image has a mask; masks are cut by grabcut")
        request = CutRequest(self._cutter(source), box, prompts)
        masks, region = cut_capture(capture, scene, request, progress=context.progress)
        masked = write_masks(made, capture, masks, region=region)
        size = " x ".join(f"{x:.3g}" for x in (region.box.upper - region.box.lower).tolist())
        context.console.say(f"the object was looked for in {region.reason}, a box of {size}")
        if not region.is_whole:
            text = "the thing that stands there continues beyond that box, so only a part of it may have been cut."
            remedy = "Give clicks in two or three images (--prompts), or --box"
            context.console.tell(Note(text, "warning", remedy))
        return masked

    def _cutter(self, source: MaskSource) -> ViewCutter:
        if source == "grabcut":
            return grabcut_mask
        if self.sam2_encoder is None or self.sam2_decoder is None:
            raise ValueError("--mask-source sam2: expected --sam2-encoder and --sam2-decoder beside it, found not both")
        return load_sam2(self.sam2_encoder, self.sam2_decoder).cut

    def _closed(
        self, object_: Gaussians, masked: MaskedViews, folder: Path, context: Context
    ) -> tuple[Gaussians, Bool[Tensor, "k"]]:
        """Close the object's unseen side; also return which Gaussians close it."""
        views, small = _small_masks(masked, CUT_SIDE_PX)
        closed = close_unseen_side(object_, views, small)
        share = closed.guessed_share
        text = f"{share:.0%} of the object's surface was never photographed: its shape and colour there are a guess."
        if share > _MUCH_GUESSED:
            middle = closed.gaussians.means.median(0).values
            gap, (first, last) = widest_gap(views, middle)
            away = views.centers - middle
            write_image(folder / COVERAGE_FILE, Coverage.of(away, away[:0], estimate_up(views)).draw())
            text += " The picture shows the directions around it from above, with its photos as dark dots."
            if gap > WIDE_GAP_DEG:
                text += f" No photo was taken over {gap:.0f} degrees around it, between {first} and {last}."
            remedy = "Photograph that side of the object too, or turn it away from the cameras (compose: yaw_deg)"
            context.console.tell(Note(text, "warning", remedy, picture=folder / COVERAGE_FILE))
        elif share > 0:
            context.console.tell(Note(text))
        return closed.gaussians, closed.is_guessed

    def _compare(
        self, masked: MaskedViews, scene: Gaussians, selection: Bool[Tensor, "n"], folder: Path, context: Context
    ) -> None:
        """Measure how well the masks agree, and write the measure with a picture."""
        cameras, small = _small_masks(masked, CUT_SIDE_PX)
        agreement = measure_agreement(small, scene, cameras.to(scene.device), selection, progress=context.progress)
        with atomic_write(folder / AGREEMENT_FILE) as stream:
            stream.write((json.dumps(agreement.as_json(), indent=1) + "\n").encode())
        doubtful = agreement.doubtful
        others = [round(i) for i in torch.linspace(0, len(small) - 1, min(_PICTURED, len(small))).tolist()]
        chosen = [*doubtful, *(i for i in dict.fromkeys(others) if i not in doubtful)][:_PICTURED]
        write_mask_sheet(folder / SHEET_FILE, masked, chosen, scene=scene, selection=selection)
        context.console.tell(*_agreement_notes(agreement, self.out / SHEET_FILE, folder / SHEET_FILE))
        context.console.tell(*_part_notes(part_shares(scene.select(selection)), folder / SHEET_FILE))


def _small_masks(masked: MaskedViews, side_px: int) -> tuple[Cameras, Sequence[Tensor]]:
    """Return the views with a longest side of at most `side_px`, and their masks, read on access."""
    cameras = masked.views.cameras.resized(min(1.0, side_px / int(masked.views.cameras.sizes.max())))
    sizes = cameras.sizes.tolist()
    return cameras, LazySequence(len(sizes), lambda index: resize(masked.masks[index], *sizes[index]))


def _photographs(masked: MaskedViews) -> tuple[PosedImages, Sequence[tuple[Tensor, Tensor]]]:
    """Return the views at the size for making the object solid, and their images and masks, read on access."""
    views = masked.views.limited(SOLID_SIDE_PX)
    sizes = views.cameras.sizes.tolist()
    read = LazySequence(len(sizes), lambda index: (views.image(index), resize(masked.masks[index], *sizes[index])))
    return views, read


def _part_notes(shares: Sequence[float], picture: Path) -> list[Note]:
    """Warn if the object is in several parts, because an object that was moved between photos appears twice."""
    large = [f"{share:.0%}" for share in shares if share > _SEPARATE]
    if len(large) < 2:
        return []
    text = f"the object is in {len(large)} separate parts, of {' and '.join(large)} of it."
    remedy = "If it is one thing, remove the photos before or after it was moved, or keep only the largest part (keep)"
    return [Note(text, "warning", remedy, picture)]


def _agreement_notes(agreement: Agreement, sheet: Path, picture: Path) -> list[Note]:
    """Describe how well the masks agree, and faults; the `picture` will be moved to `sheet`."""
    mean, names = agreement.mean, [Path(agreement.names[index]).name for index in agreement.doubtful]
    notes = [Note(f"the masks agree with the object by {mean:.0%}: {sheet}")]
    if mean < MIN_AGREEMENT:
        text = (
            f"the masks of the images do not agree on one object: they overlap by {mean:.0%}, expected at least "
            f"{MIN_AGREEMENT:.0%}."
        )
        remedy = f"Look at {sheet}, then give clicks in two or three images (--prompts) or --box"
        notes.append(Note(text, "warning", remedy, picture))
    elif names:
        shown = ", ".join(names[:_PICTURED]) + (" ..." if len(names) > _PICTURED else "")
        text = f"{len(names)} of {len(agreement.names)} masks are unlike the object ({shown}): {sheet}"
        notes.append(Note(text, "warning", picture=picture))
    return notes


COMMAND = Segment
