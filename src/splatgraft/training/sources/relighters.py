"""Relighting of whole images for training: DiffusionRenderer in the user's own installation, or a simple stand-in.

The relighter's name is written into the record of every sample.
"""

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, list_images, read_rgb, resize, srgb_from_linear, write_image
from splatgraft.runtime.child_process import last_line, run_logged

_PROGRAMS = {
    "svd": ("inference_svd_rgbx.py", "inference_svd_xrgb.py"),
    "cosmos": (
        "cosmos_predict1/diffusion/inference/inference_inverse_renderer.py",
        "cosmos_predict1/diffusion/inference/inference_forward_renderer.py",
    ),
}
"""The programs for inverse and forward rendering, by variant."""


@dataclass(frozen=True)
class RelightingInput:
    """An image to relight."""

    name: str
    image: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]
    """Of the object."""


@runtime_checkable
class Relighter(Protocol):
    """Relights images by environment maps."""

    name: str
    """For the sample's record."""
    licence: str

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the image by each environment map.

        Raises:
            ValueError: the relighter fails.
        """
        ...


class SilhouetteRelighter:
    """Shades the object's inflated silhouette by an environment map's diffuse light, without a learned model.

    It changes direction, colour and contrast of the light on the object. There are no reflections and no shape but that
    of the outline.
    """

    name = "stand-in of splatgraft (inflated silhouette, diffuse; not DiffusionRenderer)"
    licence = "own"

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the object; the other pixels stay."""
        normal = inflated_normals(draft.mask)
        pictures = []
        for path in lights:
            shading = _irradiance(read_environment(path), normal)
            inside = draft.mask[..., None]
            level = (shading * inside).sum((0, 1)) / inside.sum().clamp_min(1e-6)
            # the mean over the object and its channels is kept, so that only direction and tint change
            ratio = shading / level.mean().clamp_min(1e-6)
            linear = linear_from_srgb(draft.image) * (1 + inside * (ratio - 1))
            pictures.append(srgb_from_linear(linear).clamp(0, 1))
        return pictures


class DiffusionRenderer:
    """NVIDIA's DiffusionRenderer (Liang et al. 2025): inverse, then forward rendering, by its own programs.

    `svd`: github.com/nv-tlabs/diffusion-renderer; `cosmos`: github.com/nv-tlabs/cosmos1-diffusion-renderer. The command
    lines follow their documentation at the time of writing; untested with either.
    """

    licence = "pictures by NVIDIA's DiffusionRenderer, see its licence"

    def __init__(self, checkout: Path, python: Path, variant: Literal["svd", "cosmos"] = "svd") -> None:
        """Check an installation.

        Args:
            checkout: folder of its code.
            python: interpreter that runs it.
            variant: which of the two.

        Raises:
            ValueError: a program is missing, or the interpreter does not start.
        """
        self.name = f"DiffusionRenderer ({variant})"
        self._checkout, self._python, self._variant = checkout.resolve(), python, variant
        for program in _PROGRAMS[variant]:
            if not (checkout / program).is_file():
                raise ValueError(
                    f"{checkout}: expected an installation of {self.name} with {program}, found none; or use "
                    "--relighter stand-in"
                )
        try:
            subprocess.run([str(python), "-c", "import torch"], check=True, capture_output=True, timeout=300)
        except (OSError, subprocess.SubprocessError) as error:
            raise ValueError(f"{python}: expected a Python that runs {self.name}, found {error}") from error

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the image by each environment map; results have its size.

        Raises:
            ValueError: a program fails or writes no image.
        """
        height, width = draft.mask.shape
        with tempfile.TemporaryDirectory() as name:
            given, buffers, out = (Path(name) / part for part in ("input", "buffers", "relit"))
            (given / "picture").mkdir(parents=True)
            write_image(given / "picture" / "frame000.png", draft.image)
            size = f"[{max(64, height // 64 * 64)},{max(64, width // 64 * 64)}]"
            self._run(self._inverse(given, buffers, size))
            pictures = []
            for number, light in enumerate(lights):
                made = out / str(number)
                self._run(self._forward(buffers, made, light.resolve(), size))
                found = [path for folder in (made, *made.rglob("*")) if folder.is_dir() for path in list_images(folder)]
                if not found:
                    raise ValueError(f"{self._checkout}: expected a relit picture of {draft.name}, found none")
                pictures.append(resize(read_rgb(found[0]), width, height).clamp(0, 1))
            return pictures

    def _inverse(self, given: Path, out: Path, size: str) -> list[str]:
        if self._variant == "svd":
            settings = ["inference_n_frames=1", "chunk_mode=first", f"inference_res={size}", "save_video_fps=1"]
            config = ["--config", "configs/rgbx_inference.yaml"]
            return [*config, f"inference_input_dir={given}", f"inference_save_dir={out}", *settings]
        model = [
            "--checkpoint_dir",
            "checkpoints",
            "--diffusion_transformer_dir",
            "Diffusion_Renderer_Inverse_Cosmos_7B",
        ]
        shape = ["--num_video_frames", "1", "--group_mode", "folder", "--save_video=False"]
        return [*model, f"--dataset_path={given}", f"--video_save_folder={out}", *shape]

    def _forward(self, buffers: Path, out: Path, light: Path, size: str) -> list[str]:
        if self._variant == "svd":
            settings = ["inference_n_frames=1", f"inference_res={size}", "lora_scale=0.25", "rotate_light=false"]
            config = ["--config", "configs/xrgb_inference.yaml", "save_video=false", f"envlight=['{light}']"]
            return [*config, f"inference_input_dir={buffers}", f"inference_save_dir={out}", *settings]
        model = [
            "--checkpoint_dir",
            "checkpoints",
            "--diffusion_transformer_dir",
            "Diffusion_Renderer_Forward_Cosmos_7B",
        ]
        maps = ["--use_custom_envmap=True", f"--envlight={light}", "--num_video_frames", "1", "--save_video=False"]
        return [*model, f"--dataset_path={buffers / 'gbuffer_frames'}", f"--video_save_folder={out}", *maps]

    def _run(self, arguments: list[str]) -> None:
        inverse = any("rgbx" in word or "Inverse" in word for word in arguments)
        program = _PROGRAMS[self._variant][0 if inverse else 1]
        with tempfile.TemporaryDirectory() as name:
            log = Path(name) / "log"
            # standard output stays out of the log, whose last line is to be that of the error
            command = [str(self._python), program, *arguments]
            if run_logged(command, log, folder=self._checkout, on_line=lambda _: None) != 0:
                last = last_line(log) or "no output"
                raise ValueError(f"{self._checkout / program}: expected it to succeed, found {last[:200]}")


def inflated_normals(mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Unit normals (right, up, towards the camera) of the inflated silhouette."""
    inside = (mask > 0.5).numpy().astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    reach = max(float(depth.max()), 1.0)
    # circular profile: height^2 = reach^2 - (reach - depth)^2
    height = np.sqrt(np.maximum(reach**2 - (reach - depth) ** 2, 0)).astype(np.float32)
    height = cv2.GaussianBlur(height, (0, 0), max(reach / 10, 0.8))
    down, right = np.gradient(height)
    return F.normalize(torch.from_numpy(np.stack([-right, down, np.ones_like(height)], -1)).float(), dim=-1)


def read_environment(path: Path) -> Float[Tensor, "h w 3"]:
    """Read the linear light of an equirectangular .hdr map.

    Raises:
        ValueError: it cannot be read.
    """
    found = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR) if path.is_file() else None
    if found is None:
        raise ValueError(f"{path}: expected an environment map (.hdr), found none that can be read")
    return torch.from_numpy(np.ascontiguousarray(found[..., ::-1])).float().nan_to_num().clamp_min(0)


def _irradiance(environment: Float[Tensor, "h w 3"], normal: Float[Tensor, "h2 w2 3"]) -> Float[Tensor, "h2 w2 3"]:
    """Irradiance at each normal, up to a factor; the map is reduced to 16 x 8 directions."""
    small = resize(environment, 16, 8)
    polar = (torch.arange(8) + 0.5) / 8 * torch.pi
    azimuth = (torch.arange(16) + 0.5) / 16 * 2 * torch.pi
    theta, phi = torch.meshgrid(polar, azimuth, indexing="ij")
    direction = torch.stack([theta.sin() * phi.sin(), theta.cos(), theta.sin() * phi.cos()], -1).reshape(-1, 3)
    power = (small * theta.sin()[..., None]).reshape(-1, 3)
    return (normal @ direction.T).clamp_min(0) @ power
