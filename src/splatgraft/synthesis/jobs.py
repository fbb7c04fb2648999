"""Render jobs: what to render, and rendering it in a Blender process. Knows not what a job is for."""

import json
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

from splatgraft.runtime.child_process import run_logged
from splatgraft.runtime.workers import Task
from splatgraft.synthesis.scene import Camera, Part, Scene, Vector, World

Pass = Literal["color", "depth", "normal", "albedo", "mask"]
_WORKER = Path(__file__).parent / "blender" / "worker.py"


@dataclass(frozen=True)
class RenderSize:
    """How large and how clean pictures are."""

    width: int = 704
    height: int = 496
    samples: int = 128

    @staticmethod
    def small() -> "RenderSize":
        """A quarter of the paper's pixels, 16 samples and the denoiser."""
        return RenderSize(width=352, height=248, samples=16)


@dataclass(frozen=True)
class SurfaceSampling:
    """Points on surfaces, evenly by area, within a ball."""

    count: int
    center: Vector
    radius: float


@dataclass(frozen=True)
class Take:
    """One set of pictures of a job, from all its cameras or some."""

    name: str
    """Its folder's name."""
    scene: bool
    """Whether the scene is there; without it the background is transparent."""
    object: str = ""
    """Which object is there; none where empty."""
    passes: tuple[Pass, ...] = ("color",)
    exposure_group: str = "scene"
    """Takes of one group share one exposure, found from the first of them."""
    world: World | None = None
    """Another world than the scene's."""
    cameras: tuple[int, ...] | None = None
    stops: float = 0.0
    """Exposure on top of the group's, in photographic stops."""
    probe: Vector | None = None
    """Instead of pictures: the light that arrives at this point, `0000.npy` (64, 128, 3) and `suns.json`.

    The panorama is linear light, scaled as the pictures are: row 0 is straight up, the middle column +x, and columns
    run to the right seen from inside; small suns are left out of it and listed by themselves."""
    surface: SurfaceSampling | None = None
    """Instead of pictures: points on the object, or on the scene where none is named, `0000.npy` (n, 6): position and
    outward normal, world axes."""

    @property
    def is_pictures(self) -> bool:
        """Whether it is rendered from cameras."""
        return self.probe is None and self.surface is None


@dataclass(frozen=True)
class Job:
    """Everything that one Blender process renders."""

    scene: Scene
    objects: dict[str, tuple[Part, ...]]
    cameras: tuple[Camera, ...]
    takes: tuple[Take, ...]
    size: RenderSize
    seed: int = 0
    provenance: dict[str, str] = field(default_factory=dict)
    """Seeds, kinds and licences, kept with the pictures."""

    def files(self, out: Path) -> Iterator[Path]:
        """The marks that say which pictures are done, one for each take and camera."""
        for take in self.takes:
            every = range(len(self.cameras)) if take.is_pictures else (0,)
            for i in every if take.cameras is None else take.cameras:
                yield out / take.name / f"{i:04d}.done"

    def is_done(self, out: Path) -> bool:
        """Whether nothing is left to render."""
        return all(path.exists() for path in self.files(out))


def _description(job: Job, out: Path) -> str:
    takes = [{key: value for key, value in asdict(take).items() if value is not None} for take in job.takes]
    scene = json.loads(job.scene.to_json())
    objects = {key: [asdict(part) for part in parts] for key, parts in job.objects.items()}
    cameras = [asdict(camera) for camera in job.cameras]
    found = {"out": str(out), "scene": scene, "objects": objects, "cameras": cameras, "takes": takes, "seed": job.seed}
    return json.dumps({**found, **asdict(job.size), "provenance": job.provenance}, indent=1)


def render_job(job: Job, out: Path, blender_python: Path) -> None:
    """Render what `out` still lacks; safe to repeat, and to kill.

    Raises: ValueError where Blender fails, with its last words and the log's place.
    """
    if job.is_done(out):
        return
    out.mkdir(parents=True, exist_ok=True)
    description = out / "job.json"
    description.write_text(_description(job, out.resolve()))
    log = out / "render.log"
    code = run_logged([str(blender_python), str(_WORKER), str(description)], log)
    if not job.is_done(out):
        tail = log.read_text(errors="replace").strip().splitlines()
        said = next(
            (line for line in reversed(tail) if "Error" in line and "freed" not in line), tail[-1] if tail else ""
        )
        raise ValueError(f"{log}: expected Blender to render every picture, found exit code {code}: {said}")


def copy_shared_takes(job: Job, out: Path, elder: Job, elder_out: Path) -> None:
    """Copy from `elder_out` the whole takes that `job` would render just the same; what `out` has stays.

    The first take decides the exposure, so where that is not shared, nothing is.
    """
    alike = (elder.scene, elder.cameras, elder.size, elder.seed) == (job.scene, job.cameras, job.size, job.seed)
    shared = [
        take
        for take in job.takes
        if alike
        and take in elder.takes
        and job.objects.get(take.object) == elder.objects.get(take.object)
        and replace(elder, takes=(take,)).is_done(elder_out)
    ]
    if job.takes[0] not in shared:
        return
    out.mkdir(parents=True, exist_ok=True)
    for name in ("cameras.json", "exposure.json"):
        shutil.copyfile(elder_out / name, out / name)
    for take in shared:
        # marks last: killed here, the pictures without one are rendered again
        for path in sorted((elder_out / take.name).iterdir(), key=lambda path: path.suffix == ".done"):
            (out / take.name).mkdir(exist_ok=True)
            if not (out / take.name / path.name).exists():
                shutil.copyfile(path, out / take.name / path.name)


def check_blender(blender_python: Path) -> str:
    """Blender's version in that interpreter.

    Raises: ValueError where it has no bpy.
    """
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


def render_tasks(jobs: Sequence[tuple[Job, Path]], blender_python: Path) -> list[Task]:
    """One task a job, for `run_tasks`."""
    return [Task(out.name, partial(render_job, job, out, blender_python)) for job, out in jobs]
