"""Rendered pairs with their light-transfer priors, held in memory, for training the compact harmoniser."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb
from splatgraft.harmonization.compact.features import CompactInput, relative_depth
from splatgraft.runtime.progress import Progress, silent
from splatgraft_paper.synthesis.benchmark import rendered_cameras
from splatgraft_paper.synthesis.pairs import PairSample, read_manifest

_LINEAR = linear_from_srgb(torch.arange(256) / 255)


@dataclass(frozen=True)
class HeldOutOptions:
    """Pairs that are held out of the training, by family."""

    materials: tuple[str, ...] = ("brick",)
    """Material patterns: pairs whose object has one."""
    lights: tuple[str, ...] = ("interior.exr",)
    """Environment maps: pairs whose object was captured under one."""
    every: int = 12
    """Every so manyth scene is held out; 0 for none."""


@dataclass(frozen=True)
class PairEntry:
    """One pair: keys of its arrays."""

    folder: str
    object: str
    light: str
    camera: int
    held_out: bool


class CompactPairs:
    """All pairs of a folder that have priors, decoded."""

    def __init__(
        self, pairs: Path, priors: Sequence[Path], held_out: HeldOutOptions, progress: Progress = silent
    ) -> None:
        """Read all pairs; about 0.6 MB each at 240x160.

        Args:
            pairs: folder that `splatgraft synth pairs` rendered.
            priors: folders of `write_priors`, one per variant of the perturbed lights.
            held_out: which pairs are held out.
            progress: called after each scene.

        Raises:
            ValueError: the manifest or an image is missing or broken, or no pair has a prior.
        """
        self._arrays: dict[tuple[str, str, int], np.ndarray] = {}
        self._prior_confidence: dict[tuple[str, str], float] = {}
        self.variants = len(priors)
        self.entries: list[PairEntry] = []
        samples = read_manifest(pairs)
        folders = sorted({sample.folder for sample in samples})
        for number, folder in enumerate(folders):
            scene_held_out = held_out.every > 0 and number % held_out.every == held_out.every - 1
            paths = [found / f"{folder.name}.npz" for found in priors]
            if all(path.is_file() for path in paths):
                own = [sample for sample in samples if sample.folder == folder]
                for variant, path in enumerate(paths):
                    self._read_priors(path, own, variant)
                self._read_folder(folder, own, None if scene_held_out else held_out)
            progress(number + 1, len(folders), folder.name)
        if not self.entries:
            raise ValueError(f"{', '.join(map(str, priors))}: expected priors of the pairs in {pairs}, found none")
        self.training = [i for i, entry in enumerate(self.entries) if not entry.held_out]
        self.validation = [i for i, entry in enumerate(self.entries) if entry.held_out]

    def fingerprint(self) -> dict[str, int]:
        """Counts that must be equal for a training to be resumed."""
        return {"training": len(self.training), "validation": len(self.validation), "variants": self.variants}

    def read(self, index: int, variant: int = 0) -> tuple[CompactInput, Float[Tensor, "1 3 h w"]]:
        """Read a pair at full size with one of its priors.

        The composite's object keeps the exposure of its own light; it is not normalised as in the paper.

        Returns:
            The network's input and the ground truth in linear light.
        """
        entry = self.entries[index]

        def array(take: str) -> Tensor:
            return torch.from_numpy(self._arrays[entry.folder, take, entry.camera])

        target = _LINEAR[array(entry.object).int()]
        background = _LINEAR[array("background").int()]
        mask = array(f"{entry.object} mask").float() / 255
        relit = array(f"{entry.object}_{entry.light}").float() / 255
        covered = torch.minimum(mask, relit[..., 3])[..., None]
        composite = linear_from_srgb(covered * relit[..., :3] + (1 - covered) * array("background").float() / 255)
        depth = array(f"{entry.object} depth").float()
        view = CompactInput(
            composite=_channels_first(composite),
            background=_channels_first(background),
            mask=covered[..., 0][None, None],
            log_ratio=_channels_first(array(f"{entry.object}_{entry.light} {variant}").float()),
            depth=relative_depth(depth, mask)[None, None],
            normal=_channels_first(array(f"{entry.object} normal").float() / 127),
            prior_confidence=torch.tensor(
                [self._prior_confidence[entry.folder, f"{entry.object}_{entry.light} {variant}"]]
            ),
        )
        return view, _channels_first(target)

    def _read_priors(self, path: Path, samples: Sequence[PairSample], variant: int) -> None:
        with np.load(path, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
        for sample in samples:
            take = f"{sample.object}_{sample.light}"
            if take not in found:
                raise ValueError(f"{path}: expected a prior of {take}, found none; remove the file to remake it")
            key = f"{take} {variant}"
            self._arrays[sample.folder.name, key, sample.camera] = found[take][sample.camera]
            self._prior_confidence[sample.folder.name, key] = float(found[f"{take}_trust"])

    def _read_folder(self, folder: Path, samples: Sequence[PairSample], held_out: HeldOutOptions | None) -> None:
        """Read the images of a scene; `held_out` is None where the whole scene is held out."""
        job = json.loads((folder / "job.json").read_text())
        count = len(job["cameras"])
        cameras = rendered_cameras(folder, tuple(f"{i:04d}" for i in range(count)))
        worlds = {take["name"]: take["world"].get("path", "") for take in job["takes"] if take.get("world")}
        for sample in samples:
            patterns = {part["material"]["pattern"] for part in job["objects"][sample.object]}
            light = worlds[f"{sample.object}_{sample.light}"]
            pair_held_out = held_out is None or bool(patterns & set(held_out.materials)) or light in held_out.lights
            self.entries.append(PairEntry(folder.name, sample.object, sample.light, sample.camera, pair_held_out))
            self._read_images(sample, cameras.camera_from_world[sample.camera, :3, :3].numpy())

    def _read_images(self, sample: PairSample, camera_from_world: np.ndarray) -> None:
        name, i = sample.folder.name, sample.camera
        for take in (sample.object, "background", f"{sample.object}_{sample.light}"):
            self._arrays.setdefault((name, take, i), _read_image(sample.path(take)))
        if (name, f"{sample.object} mask", i) in self._arrays:
            return
        mask = _read_image(sample.path(sample.object, "mask"))
        self._arrays[name, f"{sample.object} mask", i] = mask if mask.ndim == 2 else mask[..., 0]
        depth = np.load(sample.path(sample.object, "depth"), allow_pickle=False)
        self._arrays[name, f"{sample.object} depth", i] = depth
        normal = _read_image(sample.path(sample.object, "normal")).astype(np.float32) / 127.5 - 1
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        in_camera = np.where((depth > 0)[..., None], normal / np.maximum(length, 1e-3), 0) @ camera_from_world.T
        self._arrays[name, f"{sample.object} normal", i] = np.round(127 * in_camera).astype(np.int8)


def _channels_first(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
    return image.permute(2, 0, 1)[None]


def _read_image(path: Path) -> np.ndarray:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise ValueError(f"{path}: expected a picture, found none that can be read")
    if found.ndim == 3:
        code = cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGB
        found = cv2.cvtColor(found, code)
    return found
