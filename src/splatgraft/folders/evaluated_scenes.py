"""Pictures of the same views of result, composite, target and, if there is one, ground truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.evaluation import ComparedView, Truth
from splatgraft.folders.capture_files import capture_inputs
from splatgraft.folders.composite_folder import guessed_gaussians, photographed_side
from splatgraft.formats import read_cameras, read_gaussians, read_images
from splatgraft.project.gaussian_flags import read_selection
from splatgraft.project.layout import CAMERAS_FILE, IS_OBJECT_FILE, SCENE_FILE
from splatgraft.rendering import render
from splatgraft.runtime.lazy_sequence import LazySequence

_LOOKED_AT = 40  # maximum number of views among which the best is sought


@dataclass(frozen=True)
class Pictures:
    """One view before and after the transfer; sRGB in [0, 1]."""

    name: str
    """Name of the view."""
    before: Float[Tensor, "h w 3"]
    """Target without the object."""
    copy_paste: Float[Tensor, "h w 3"]
    """Composite with the object as captured, without relighting."""
    result: Float[Tensor, "h w 3"]
    """Final scene."""
    mask: Float[Tensor, "h w"]
    """Coverage of the object, in [0, 1]."""
    truth: Float[Tensor, "h w 3"] | None = None
    """Photograph with the real object; None without ground truth."""
    held_out: bool = False
    """Whether the consolidation used no image of this view."""
    guessed_share: float = 0.0
    """Share of the object's coverage that no photograph shows, in [0, 1]."""

    @property
    def prominence(self) -> float:
        """Visibility of the object in the view: its coverage, pixels, reduced for guessed parts, and if the border cuts
        it."""
        return _prominence(self.mask, self.guessed_share)


@dataclass(frozen=True)
class EvaluatedScenes:
    """Compared scenes, on one device."""

    result: Gaussians
    """Scene after consolidation."""
    composite: Gaussians
    """Target with the object as captured."""
    is_object: Bool[Tensor, "n"]
    """Mask of the object's Gaussians in the composite."""
    is_guessed: Bool[Tensor, "n"]
    """Mask of those that close the side that no photograph shows."""
    cameras: Cameras
    """Cameras of the target."""

    @staticmethod
    def read(result: Path, composite: Path, cameras: Path, *, device: torch.device) -> "EvaluatedScenes":
        """Read all scenes."""
        scene = read_gaussians(composite / SCENE_FILE)
        is_object = read_selection(composite / IS_OBJECT_FILE, scene.count, composite / SCENE_FILE)
        return EvaluatedScenes(
            result=read_gaussians(result).to(device),
            composite=scene.to(device),
            is_object=is_object.to(device),
            is_guessed=guessed_gaussians(composite, is_object).to(device),
            cameras=read_cameras(cameras).to(device),
        )

    def with_width(self, width: int | None) -> "EvaluatedScenes":
        """Resize the cameras to `width` pixels; no change if it is None."""
        if width is None:
            return self
        return replace(self, cameras=self.cameras.resized(width / float(self.cameras.sizes[:, 0].max())))

    @property
    def object_center(self) -> Float[Tensor, "3"]:
        """Median of the object's Gaussians, world units; of all Gaussians if there is no object."""
        chosen = self.composite.select(self.is_object) if bool(self.is_object.any()) else self.composite
        return chosen.means.median(0).values

    @property
    def photographed_side(self) -> Float[Tensor, "3"] | None:
        """Horizontal direction from the object to the photographed side; None if all sides were photographed."""
        up = estimate_up(self.cameras).to(self.composite.means)
        return photographed_side(self.composite, self.is_object, self.is_guessed, up)

    def picture(self, scene: Gaussians, camera: Cameras) -> Float[Tensor, "h w 3"]:
        """Render one view of one scene, clamped to [0, 1], on the CPU."""
        color = render(scene, camera).color
        return color[0].cpu().clamp(0, 1)

    @property
    def best_view(self) -> int:
        """Index of the camera with the largest `Pictures.prominence`, among at most `_LOOKED_AT`."""
        small = self.cameras.resized(min(1.0, 160 / int(self.cameras.sizes.max())))
        every = math.ceil(len(small) / _LOOKED_AT)
        return max(range(0, len(small), every), key=lambda index: _prominence(*self._object_from(small[index])))

    def pictures_from(self, camera: Cameras) -> Pictures:
        """Render the pictures of one view."""
        object_, guessed_share = self._object_from(camera)
        return Pictures(
            name=camera.names[0],
            before=self.picture(self.composite.select(~self.is_object), camera),
            copy_paste=self.picture(self.composite, camera),
            result=self.picture(self.result, camera),
            mask=object_,
            guessed_share=guessed_share,
        )

    def _object_from(self, camera: Cameras) -> tuple[Float[Tensor, "h w"], float]:
        """Render the object's coverage, and compute the share of it that no photograph shows."""
        flags = torch.stack([self.is_object, self.is_guessed], 1).float()
        drawn = render(self.composite, camera, features=flags, outputs=frozenset())
        object_, guessed = drawn.features[0].cpu().clamp(0, 1).unbind(-1)
        return object_, float(guessed.sum() / object_.sum().clamp_min(1e-6))


def _prominence(mask: Float[Tensor, "h w"], guessed_share: float) -> float:
    rim = torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    cut = 0.05 if bool((rim > 0.5).any()) else 1.0
    # set by hand: a photographed share of 0.8 counts 0.4
    return float(mask.sum()) * (1 - guessed_share) ** 4 * cut


@dataclass(frozen=True)
class TrueViews:
    """Images of a ground truth, matched with images of the target without the object."""

    truth: PosedImages
    """Photographs with the real object, and a mask for every view."""
    target: PosedImages
    """Photographs without the object."""
    backgrounds: tuple[int, ...]
    """Index of the target's image of the same name, for each view of the truth."""
    harmonized_stems: frozenset[str]
    """Names, without suffix, of the views that the consolidation used."""

    @staticmethod
    def read(truth: Path, target_capture: Path | None, harmonized: Path | None) -> "TrueViews":
        """Read the ground truth, and match its views with the target's."""
        views = read_images(truth)
        if target_capture is None:
            raise ValueError("--ground-truth: expected --target-capture, the images without the object, found none")
        if not views.mask_paths or None in views.mask_paths:
            raise ValueError(f"{truth}: expected a mask for every view of the ground truth, found some missing")
        target = read_images(target_capture)
        places = {Path(name).stem: index for index, name in enumerate(target.cameras.names)}
        stems = [Path(name).stem for name in views.cameras.names]
        if missing := [stem for stem in stems if stem not in places]:
            raise ValueError(
                f"{target_capture}: expected an image named {missing[0]} as in the ground truth, found none"
            )
        used = target.cameras.names if harmonized is None else read_cameras(harmonized / CAMERAS_FILE).names
        return TrueViews(
            views, target, tuple(places[stem] for stem in stems), frozenset(Path(name).stem for name in used)
        )

    def pictures(self, scenes: EvaluatedScenes, index: int) -> Pictures:
        """Render the pictures of one view of the ground truth."""
        shown = scenes.pictures_from(self.truth.cameras[index].to(scenes.result.device))
        held_out = Path(shown.name).stem not in self.harmonized_stems
        return replace(shown, truth=self.truth.image(index), held_out=held_out)

    def compared(self, scenes: EvaluatedScenes) -> Sequence[ComparedView]:
        """Pair every view with renders from the same camera, made on access."""
        return LazySequence(len(self.truth), lambda index: self._compared(scenes, index))

    def _compared(self, scenes: EvaluatedScenes, index: int) -> ComparedView:
        shown, mask = self.pictures(scenes, index), self.truth.mask(index)
        assert shown.truth is not None
        assert mask is not None
        background = self.target.image(self.backgrounds[index])
        return ComparedView(
            name=shown.name,
            held_out=shown.held_out,
            copy_paste=shown.copy_paste,
            result=shown.result,
            background=shown.before,
            truth=Truth(image=shown.truth, background=background, mask=mask),
        )


def truth_files(truth: Path | None, target_capture: Path | None) -> tuple[Path, ...]:
    """List all files of the ground truth and of the images without the object."""
    files: list[Path] = []
    for path in (truth, target_capture):
        if path is not None:
            for part in capture_inputs(path, read_images(path), masks=True).values():
                files += part
    return tuple(files)
