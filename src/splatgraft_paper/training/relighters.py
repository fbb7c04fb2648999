"""Relighting of whole images for training: NVIDIA's DiffusionRenderer, and a simple stand-in without a learned model.

DiffusionRenderer (Liang et al. 2025) runs in the user's own installation: `svd` is
github.com/nv-tlabs/diffusion-renderer, `cosmos` github.com/nv-tlabs/cosmos1-diffusion-renderer. Their programs for
inverse and forward rendering are called with their own command lines by one process that lives as long as the relighter
(`renderer_worker.py`), so that each model is loaded once. tests/paper/diffusion_renderer_options.json has the options
of both as their repositories have them. Untested with the real programs and weights.
"""

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, read_rgb, resize, srgb_from_linear, write_image
from splatgraft.runtime.process import last_line


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


Variant = Literal["svd", "cosmos"]
_WORKER = Path(__file__).with_name("renderer_worker.py")
_COSMOS = "cosmos_predict1/diffusion/inference"
_PROGRAMS = {
    "svd": ("inference_svd_rgbx.py", "inference_svd_xrgb.py"),
    "cosmos": (f"{_COSMOS}/inference_inverse_renderer.py", f"{_COSMOS}/inference_forward_renderer.py"),
}
"""The programs for inverse and forward rendering, by variant."""
_COSMOS_HEIGHT, _COSMOS_WIDEST = 704, 1280
"""Pixels: the size of cosmos's defaults; narrower pictures get less width. Set by hand."""


@dataclass(frozen=True)
class RenderSize:
    """Size that the models work at."""

    height: int
    width: int

    @staticmethod
    def of(variant: Variant, height: int, width: int) -> "RenderSize":
        """The size for pictures of `height` x `width`: multiples of 64 (svd) or 16 (cosmos) pixels."""
        if variant == "svd":
            return RenderSize(max(64, height // 64 * 64), max(64, width // 64 * 64))
        return RenderSize(
            _COSMOS_HEIGHT, min(_COSMOS_WIDEST, max(16, round(_COSMOS_HEIGHT * width / height / 16) * 16))
        )


def inverse_arguments(variant: Variant, given: Path, out: Path, size: RenderSize) -> list[str]:
    """Arguments of the inverse renderer: one picture in a sub-folder of `given`, G-buffers as pictures below `out`."""
    if variant == "svd":
        # the configuration's overlap of 6 frames is refused with a single frame
        settings = ["inference_n_frames=1", "overlap_n_frames=0", "chunk_mode=first", "image_group_mode=folder"]
        files = [f"inference_input_dir={given}", f"inference_save_dir={out}"]
        size_and_form = [f"inference_res=[{size.height},{size.width}]", "save_video=false", "save_image=true"]
        return ["--config", "configs/rgbx_inference.yaml", *files, *settings, *size_and_form]
    model = _cosmos_model("Diffusion_Renderer_Inverse_Cosmos_7B", size)
    form = ["--group_mode", "folder", "--save_image", "True", "--save_video", "False"]
    return [*model, "--dataset_path", str(given), "--video_save_folder", str(out), *form]


def forward_arguments(
    variant: Variant, buffers: Path, out: Path, lights: Sequence[Path], size: RenderSize
) -> list[str]:
    """Arguments of the forward renderer: the G-buffers below `buffers` under all lights, pictures below `out`."""
    if variant == "svd":
        settings = ["inference_n_frames=1", "image_group_mode=webdataset", "lora_scale=0.25", "rotate_light=false"]
        files = [f"inference_input_dir={buffers}", f"inference_save_dir={out}"]
        maps = f"envlight={json.dumps([str(path) for path in lights])}"
        size_and_form = [f"inference_res=[{size.height},{size.width}]", "save_video=false", "save_image=true"]
        return ["--config", "configs/xrgb_inference.yaml", *files, *settings, *size_and_form, maps]
    model = _cosmos_model("Diffusion_Renderer_Forward_Cosmos_7B", size)
    # maps are named by their place in the program's list, which the worker fills
    maps = ["--use_custom_envmap", "True", "--envlight_ind", *(str(i) for i in range(len(lights)))]
    files = ["--dataset_path", str(buffers / "gbuffer_frames"), "--video_save_folder", str(out)]
    return [*model, *files, *maps, "--rotate_light", "False", "--save_image", "True"]


def _cosmos_model(weights: str, size: RenderSize) -> list[str]:
    checkpoint = ["--checkpoint_dir", "checkpoints", "--diffusion_transformer_dir", weights]
    return [*checkpoint, "--num_video_frames", "1", "--height", str(size.height), "--width", str(size.width)]


class DiffusionRenderer:
    """A relighter: inverse, then forward rendering by DiffusionRenderer's programs, in one long-lived process."""

    licence = "pictures by NVIDIA's DiffusionRenderer, see its licence"

    def __init__(self, checkout: Path, python: Path, variant: Variant = "svd") -> None:
        """Check an installation.

        Args:
            checkout: folder of its code.
            python: interpreter that runs it.
            variant: which of the two.

        Raises:
            ValueError: a program is missing, or the interpreter does not start.
        """
        self.name = f"DiffusionRenderer ({variant})"
        self._checkout = checkout.resolve()
        self._variant: Variant = variant
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
        self._worker = _Worker(python, self._checkout)

    def relight(self, draft: RelightingInput, lights: Sequence[Path]) -> list[Float[Tensor, "h w 3"]]:
        """Relight the image by each environment map; results have its size.

        Raises:
            ValueError: a program fails or writes no image.
        """
        height, width = draft.mask.shape
        size = RenderSize.of(self._variant, height, width)
        inverse, forward = _PROGRAMS[self._variant]
        maps = [light.resolve() for light in lights]
        with tempfile.TemporaryDirectory() as name:
            given, buffers, out = (Path(name) / part for part in ("input", "buffers", "relit"))
            (given / "picture").mkdir(parents=True)
            write_image(given / "picture" / "frame000.png", draft.image)
            self._worker.run(inverse, inverse_arguments(self._variant, given, buffers, size), maps)
            self._worker.run(forward, forward_arguments(self._variant, buffers, out, maps, size), maps)
            return [resize(self._made(out, i, draft.name), width, height).clamp(0, 1) for i in range(len(maps))]

    def _made(self, out: Path, light: int, name: str) -> Float[Tensor, "_ _ 3"]:
        pattern = f"*.env{light:04d}.png" if self._variant == "svd" else f"relit_frames_{light:04d}/**/*.jpg"
        found = sorted(out.rglob(pattern))
        if not found:
            raise ValueError(f"{self._checkout}: expected a relit picture of {name}, found none")
        return read_rgb(found[0])

    def close(self) -> None:
        """End the process; it also ends with this one."""
        self._worker.close()


class _Worker:
    """The process of `renderer_worker.py`, started at the first job."""

    def __init__(self, python: Path, checkout: Path) -> None:
        self._python, self._checkout = python, checkout
        self._process: subprocess.Popen[bytes] | None = None
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._log = Path(folder) / "log"

    def run(self, program: str, arguments: Sequence[str], lights: Sequence[Path]) -> None:
        """Run one program to its end.

        Raises:
            ValueError: it fails.
        """
        process = self._process if self._process is not None and self._process.poll() is None else self._start()
        job = {"program": program, "arguments": list(arguments), "lights": [str(path) for path in lights]}
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(job).encode() + b"\n")
            process.stdin.flush()
            answer: dict[str, Any] = json.loads(process.stdout.readline())
        except (OSError, ValueError):
            answer = {"error": f"its process ended ({last_line(self._log) or 'no output'})"}
        if answer["error"] is not None:
            status = answer["error"].startswith("exit status")
            found = " ".join(((status and last_line(self._log)) or answer["error"]).split())[:200]
            raise ValueError(f"{self._checkout / program}: expected it to succeed, found {found}")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            _end(self._process)
            self._process = None

    def _start(self) -> subprocess.Popen[bytes]:
        self.close()
        # both repositories run their programs with the folder of their code in PYTHONPATH
        path = os.pathsep.join(filter(None, (str(self._checkout), os.environ.get("PYTHONPATH"))))
        with self._log.open("ab") as stream:
            self._process = subprocess.Popen(
                [str(self._python), str(_WORKER)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stream,
                cwd=self._checkout,
                env={**os.environ, "PYTHONPATH": path},
            )
        weakref.finalize(self, _end, self._process)
        return self._process


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Close the pipes of a process and wait for it."""
    if process.stdin is not None and not process.stdin.closed:
        with contextlib.suppress(OSError):  # it has gone already
            process.stdin.close()
    process.terminate()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()
