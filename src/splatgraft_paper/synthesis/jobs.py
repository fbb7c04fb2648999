"""Render jobs, their rendering in Blender processes, and lists of failures."""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from splatgraft.runtime.console import Console
from splatgraft.runtime.process import run_logged
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft_paper.synthesis.scene import Camera, Part, Scene, Vector, World

Pass = Literal["color", "depth", "mask"]
_WORKER = Path(__file__).parent / "blender" / "worker.py"


@dataclass(frozen=True)
class RenderSize:
    """Size and sampling of rendered pictures."""

    width: int = 704
    height: int = 496
    samples: int = 128
    """Light paths per pixel."""


@dataclass(frozen=True)
class SurfaceSampling:
    """Sampling of surface points, uniform by area, within a sphere; metres."""

    count: int
    center: Vector
    radius: float = 8.0
    """Radius of the sphere, larger than any object."""


@dataclass(frozen=True)
class Take:
    """One set of pictures of a job, from all its cameras, or a measurement of light or surfaces."""

    name: str
    """Name of the take and of its folder."""
    scene: bool
    """Whether the scene is rendered; if not, the background is transparent."""
    object: str = ""
    """Name of the rendered object; empty for none."""
    passes: tuple[Pass, ...] = ("color",)
    exposure_group: str = "scene"
    """Group of takes that share one exposure, computed from the first of them."""
    world: World | None = None
    """World that replaces the scene's."""
    probe: Vector | None = None
    """Point whose light is measured instead of pictures: `0000.npy` (64, 128, 3) and `suns.json`.

    The panorama is linear light at the exposure of the pictures: row 0 is straight up, the middle column +x, and
    columns run to the right as seen from inside. It leaves out the suns, which `suns.json` lists."""
    surface: SurfaceSampling | None = None
    """Sampling of surface points instead of pictures: `0000.npy` (n, 6), position and outward normal, world axes.

    Points lie on the object, or on the scene if no object is named."""

    @property
    def is_pictures(self) -> bool:
        """Whether the take is rendered from the cameras."""
        return self.probe is None and self.surface is None


@dataclass(frozen=True)
class Model:
    """A .glb that stands upright in a scene."""

    path: str
    size: float
    """Metres per unit of the file's metre."""
    location: Vector
    """Place of its origin."""


@dataclass(frozen=True)
class Job:
    """Description of the pictures that one Blender process renders."""

    scene: Scene
    objects: Mapping[str, tuple[Part, ...] | Model]
    cameras: tuple[Camera, ...]
    takes: tuple[Take, ...]
    size: RenderSize
    seed: int = 0
    provenance: dict[str, str] = field(default_factory=dict)
    """Seeds, kinds and licences; written beside the pictures."""

    def is_done(self, out: Path) -> bool:
        """Return whether everything is rendered; a .done file marks each finished picture."""
        counts = {take.name: len(self.cameras) if take.is_pictures else 1 for take in self.takes}
        return all((out / name / f"{i:04d}.done").exists() for name, count in counts.items() for i in range(count))


def _description(job: Job, out: Path) -> str:
    found = asdict(job)
    takes = [{key: value for key, value in take.items() if value is not None} for take in found["takes"]]
    named = {name: found[name] for name in ("scene", "objects", "cameras")}
    record = {"out": str(out), **named, "takes": takes, "seed": job.seed, **found["size"]}
    return json.dumps({**record, "provenance": job.provenance}, indent=1)


def render_job(job: Job, out: Path, blender_python: Path) -> None:
    """Render missing files into `out`, and write job.json and render.log; an interrupted job can be repeated."""
    if job.is_done(out):
        return
    out.mkdir(parents=True, exist_ok=True)
    description = out / "job.json"
    description.write_text(_description(job, out.resolve()), encoding="utf-8")
    log = out / "render.log"
    code = run_logged([str(blender_python), str(_WORKER), str(description)], log)
    if not job.is_done(out):
        tail = log.read_text(errors="replace", encoding="utf-8").strip().splitlines() or [""]
        said = next((line for line in reversed(tail) if "Error" in line and "freed" not in line), tail[-1])
        raise ValueError(f"{log}: expected Blender to render every picture, found exit code {code}: {said}")


def check_blender(blender_python: Path) -> str:
    """Return the version of Blender in a Python interpreter."""
    command = [str(blender_python), "-c", "import bpy; print('version', bpy.app.version_string)"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ValueError(f"{blender_python}: expected a Python with bpy, found {error.strerror}") from error
    found = [line for line in done.stdout.splitlines() if line.startswith("version ")]
    if done.returncode or not found:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise ValueError(
            f"{blender_python}: expected a Python with bpy (pip install 'splatgraft[blender]' in a Python 3.11), "
            f"found {last}"
        )
    return found[-1].removeprefix("version ")


@dataclass(frozen=True)
class RenderWorkers:
    """Blender processes that render."""

    blender_python: Path | None = None
    """Python 3.11 with bpy; default: the running interpreter."""
    processes: int = 2
    """Number of Blender processes at a time on this machine."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see the folder; `local`: one of this machine's cores."""

    def python(self, console: Console) -> Path:
        """Return the interpreter after a trial import of bpy."""
        found = self.blender_python or Path(sys.executable)
        console.say(f"blender: {check_blender(found)} in {found}")
        return found

    def run(self, tasks: list[Task], console: Console) -> list[str]:
        """Render, and return one line per failed task."""
        with console.bar("render") as progress:
            return run_tasks(tasks, at_once=self.processes, ray_address=self.ray, progress=progress)


def parse_image_size(text: str, *, multiple_of: int = 1) -> tuple[int, int]:
    """Parse --size WIDTHxHEIGHT; both sides must be multiples of `multiple_of` pixels."""
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) and int(part) % multiple_of == 0 for part in parts):
        wanted = "WIDTHxHEIGHT" if multiple_of == 1 else f"WIDTHxHEIGHT in multiples of {multiple_of}"
        raise ValueError(f"--size: expected {wanted}, found {text}")
    return int(parts[0]), int(parts[1])


def read_render_size(text: str, samples: int) -> RenderSize:
    """Parse the size WIDTHxHEIGHT of rendered pictures."""
    size = parse_image_size(text)
    if min(*size, 16 * samples) < 16:
        raise ValueError(f"--size, --samples: expected at least 16x16 and one sample, found {text}, {samples}")
    return RenderSize(*size, samples)


def write_failures(out: Path, failures: list[str], console: Console) -> None:
    """Write failures.txt and print its first lines; remove the file if nothing failed."""
    path = out / "failures.txt"
    path.unlink(missing_ok=True)
    if failures:
        path.write_text("\n".join(failures) + "\n", encoding="utf-8")
        for failure in failures[:10]:
            console.say(failure)
        console.say(f"{len(failures)} failures, all in {path}")
