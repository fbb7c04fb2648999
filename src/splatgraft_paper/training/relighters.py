"""Relighting of whole images for training, by NVIDIA's DiffusionRenderer or a stand-in without a learned model.

DiffusionRenderer (Liang et al. 2025, github.com/nv-tlabs/diffusion-renderer) runs in the user's own installation. One
process (`renderer_worker.py`) calls its programs for inverse and forward rendering with their command lines and loads
each model once. tests/paper/diffusion_renderer_options.json lists the programs' options. Untested with the real
programs and weights.
"""

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, read_rgb, resize, srgb_from_linear, write_image
from splatgraft.runtime.process import last_line


class StandInRelighter:
    """Multiplication of the object by the mean colour of an environment map.

    Only the tint of the light changes, but not its direction or shadows; this is enough to try the steps without a GPU.
    """

    name = "stand-in of splatgraft (the map's mean colour; not DiffusionRenderer)"
    licence = "own"

    def relight(
        self, image: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"], lights: Sequence[Path]
    ) -> list[Float[Tensor, "h w 3"]]:
        """Relight the object by each map; the other pixels do not change."""
        linear, pictures = linear_from_srgb(image), []
        for path in lights:
            found = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
            if found is None:
                raise ValueError(f"{path}: expected an environment map (.hdr), found none that can be read")
            color = torch.from_numpy(found.reshape(-1, 3).mean(0)[::-1].copy()).float()
            tint = color / color.mean().clamp_min(1e-6)
            pictures.append(srgb_from_linear(linear * (1 + mask[..., None] * (tint - 1))).clamp(0, 1))
        return pictures


_WORKER = Path(__file__).with_name("renderer_worker.py")
_INVERSE, _FORWARD = "inference_svd_rgbx.py", "inference_svd_xrgb.py"
_MULTIPLE = 64  # pixels; the models' pictures have sides that are multiples of it


def inverse_arguments(given: Path, out: Path, size: tuple[int, int]) -> list[str]:
    """List the inverse renderer's arguments: one picture in a sub-folder of `given`, G-buffers below `out`."""
    # the program rejects the configuration's overlap of 6 frames for a single frame
    settings = ["inference_n_frames=1", "overlap_n_frames=0", "chunk_mode=first", "image_group_mode=folder"]
    return ["--config", "configs/rgbx_inference.yaml", *_files(given, out, size), *settings]


def forward_arguments(buffers: Path, out: Path, lights: Sequence[Path], size: tuple[int, int]) -> list[str]:
    """List the forward renderer's arguments: G-buffers below `buffers`, pictures under all lights below `out`."""
    settings = ["inference_n_frames=1", "image_group_mode=webdataset", "lora_scale=0.25", "rotate_light=false"]
    maps = f"envlight={json.dumps([str(path) for path in lights])}"
    return ["--config", "configs/xrgb_inference.yaml", *_files(buffers, out, size), *settings, maps]


def _files(given: Path, out: Path, size: tuple[int, int]) -> list[str]:
    places = [f"inference_input_dir={given}", f"inference_save_dir={out}", f"inference_res=[{size[0]},{size[1]}]"]
    return [*places, "save_video=false", "save_image=true"]


class DiffusionRenderer:
    """Inverse, then forward rendering with DiffusionRenderer's programs, in one long-lived process."""

    name = "DiffusionRenderer"
    licence = "pictures by NVIDIA's DiffusionRenderer, see its licence"

    def __init__(self, checkout: Path, python: Path) -> None:
        """Check an installation: its programs, and their interpreter."""
        for program in (_INVERSE, _FORWARD):
            if not (checkout / program).is_file():
                raise ValueError(
                    f"{checkout}: expected an installation of DiffusionRenderer with {program}, found none; or use "
                    "--relighter stand-in"
                )
        try:
            subprocess.run([str(python), "-c", "import torch"], check=True, capture_output=True, timeout=300)
        except (OSError, subprocess.SubprocessError) as error:
            raise ValueError(f"{python}: expected a Python that runs DiffusionRenderer, found {error}") from error
        self._checkout, self._python = checkout.resolve(), python
        self._process: subprocess.Popen[bytes] | None = None
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._log = Path(folder) / "log"

    def relight(
        self, image: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"], lights: Sequence[Path]
    ) -> list[Float[Tensor, "h w 3"]]:
        """Relight the image by each map; it is padded by reflection for the models, and the results are cropped."""
        height, width = mask.shape
        size = (-(-height // _MULTIPLE) * _MULTIPLE, -(-width // _MULTIPLE) * _MULTIPLE)
        border = (0, size[0] - height, 0, size[1] - width)
        padded = torch.from_numpy(cv2.copyMakeBorder(image.cpu().numpy(), *border, cv2.BORDER_REFLECT_101))
        maps = [light.resolve() for light in lights]
        with tempfile.TemporaryDirectory() as name:
            given, buffers, out = (Path(name) / part for part in ("input", "buffers", "relit"))
            (given / "picture").mkdir(parents=True)
            write_image(given / "picture" / "frame000.png", padded)
            self._run(_INVERSE, inverse_arguments(given, buffers, size))
            self._run(_FORWARD, forward_arguments(buffers, out, maps, size))
            relit = []
            for number, light in enumerate(maps):
                found = sorted(out.rglob(f"*.env{number:04d}.png"))
                if not found:
                    raise ValueError(f"{self._checkout}: expected a picture relit by {light}, found none")
                relit.append(resize(read_rgb(found[0]), size[1], size[0])[:height, :width].clamp(0, 1))
            return relit

    def close(self) -> None:
        """End the process; the next picture starts a new one."""
        if self._process is not None:
            _end(self._process)
            self._process = None

    def _run(self, program: str, arguments: list[str]) -> None:
        """Run one program to its end in the process of `renderer_worker.py`."""
        process = self._process if self._process is not None and self._process.poll() is None else self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"program": program, "arguments": arguments}).encode() + b"\n")
            process.stdin.flush()
            answer: dict[str, Any] = json.loads(process.stdout.readline())
        except (OSError, ValueError):
            # the process has closed its pipes, but may still be ending
            self.close()
            answer = {"error": f"its process ended ({last_line(self._log) or 'no output'})"}
        if answer["error"] is not None:
            status = answer["error"].startswith("exit status")
            found = " ".join(((status and last_line(self._log)) or answer["error"]).split())[:200]
            raise ValueError(f"{self._checkout / program}: expected it to succeed, found {found}")

    def _start(self) -> subprocess.Popen[bytes]:
        self.close()
        # the programs expect the folder of their code in PYTHONPATH
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
        with contextlib.suppress(OSError):  # the process may have ended
            process.stdin.close()
    process.terminate()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()
