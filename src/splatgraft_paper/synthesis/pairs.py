"""Training pairs (paper, Sec. 5.1 and 5.2), planned as render jobs and read as composite and target.

Files of a scene and camera arc, in `<out>/<scene>_<arc>/`:

    job.json, cameras.json, exposure.json    the job, poses (OpenGL axes), exposures
    background/0000.png ...                  the scene without any object, 8-bit sRGB, one file per camera
    object0/0000.png, 0000_mask.png          with object 0: the consistent target; soft coverage by the object
    object0_light0/0000.png                  object 0 alone under another environment map, RGBA, straight alpha
"""

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import read_rgb, read_straight_rgb
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft_paper.synthesis import objects
from splatgraft_paper.synthesis.furniture import placed
from splatgraft_paper.synthesis.jobs import Job, RenderSize, Take, write_failures
from splatgraft_paper.synthesis.places import KINDS, SUPPLIED_MAPS, make_scene
from splatgraft_paper.synthesis.scene import ARC_LENGTH, World, camera_arc

PAPER_SCENES, PAPER_LIGHTS = 190, 27
"""Numbers of scenes and lights; two objects a scene make the paper's 1,900 targets and over 51,000 composites."""
_SECONDS_PER_SAMPLE = 7.5e-6  # CPU seconds per light path; 704x496 pixels with 128 samples took 336 s on an AMD EPYC
_ALONE_SHARE = 0.1  # render time of an object alone, relative to its scene


@dataclass(frozen=True)
class PairPlan:
    """Options of a set of pairs; a scene gives 5 cameras x objects x lights pairs."""

    objects: int = 2
    """Objects per scene; the background is rendered once for all."""
    lights: int = 3
    """Environment maps per object."""
    seed: int = 0
    size: RenderSize = field(default_factory=RenderSize)
    maps: tuple[str, ...] = SUPPLIED_MAPS
    """Environment maps: files, or names of maps that come with Blender."""

    @property
    def targets(self) -> int:
        """Number of consistent pictures of a scene."""
        return ARC_LENGTH * self.objects

    @property
    def composites(self) -> int:
        """Number of inconsistent pictures of a scene."""
        return self.targets * self.lights

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds to render a scene, within about a factor of 2."""
        pictures = ARC_LENGTH + self.targets + _ALONE_SHARE * self.composites
        return pictures * _SECONDS_PER_SAMPLE * self.size.samples * self.size.width * self.size.height


def plan(options: PairPlan, number: int) -> Job:
    """Plan the job of scene `number`; it follows from the number and the seed."""
    rng = random.Random(f"pairs-{options.seed}-{number}")
    kind = KINDS[number % len(KINDS)]
    scene = make_scene(kind, options.seed * 100_003 + number)
    place = scene.places[0]
    things, heights = {}, []
    for i in range(options.objects):
        parts = objects.make(rng.randrange(2**31), place)
        heights.append(max(part.location[2] + part.size[2] / 2 for part in parts))
        things[f"object{i}"] = placed(parts, place.location, rng.uniform(0, 6.283))
    takes = [Take("background", scene=True)]
    for name in things:
        takes.append(Take(name, scene=True, object=name, passes=("color", "mask")))
        for light in range(options.lights):
            world = World("environment", path=rng.choice(options.maps), rotation=rng.uniform(0, 6.283))
            alone = f"{name}_light{light}"
            takes.append(Take(alone, scene=False, object=name, world=world, exposure_group=alone))
    cameras = camera_arc(scene, place, max(heights), number)
    provenance = {"kind": kind, "seed": str(options.seed), "number": str(number), "licence": "own render"}
    return Job(scene, things, cameras, tuple(takes), options.size, number, provenance)


def job_folder_name(job: Job) -> str:
    """Return the name of the job's folder."""
    return f"{job.scene.name}_{job.seed:05d}"


@dataclass(frozen=True)
class PairSample:
    """One training pair on disk, identified by folder, camera, object and light."""

    folder: Path
    camera: int
    object: str
    light: str

    def path(self, take: str, kind: str = "") -> Path:
        """Return the path of a take's pass for this camera."""
        return self.folder / take / f"{self.camera:04d}{'_' + kind if kind else ''}.png"


def match_statistics(
    relit: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Match the relit object's mean and deviation per channel to those of the object in the scene (Sec. 5.2)."""
    weight = mask[..., None] / mask.sum().clamp_min(1e-6)

    def moments(image: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        mean = (image * weight).sum((0, 1))
        return mean, ((image - mean) ** 2 * weight).sum((0, 1)).sqrt()

    (relit_mean, relit_deviation), (mean, deviation) = moments(relit), moments(target)
    return ((relit - relit_mean) / relit_deviation.clamp_min(1e-4) * deviation + mean).clamp(0, 1)


def composite(
    relit: Float[Tensor, "h w 3"], background: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Compute M * relit + (1 - M) * background (paper, Eq. 2); `relit` is not multiplied by its coverage M."""
    return mask[..., None] * relit + (1 - mask[..., None]) * background


def samples_in(folder: Path) -> list[PairSample]:
    """List all pairs of a rendered folder, from its job.json."""
    path = folder / "job.json"
    try:
        job = json.loads(path.read_text(encoding="utf-8"))
        takes, cameras = [take["name"] for take in job["takes"]], len(job["cameras"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected the description of a render job, found {error}") from error
    alone = [words for take in takes if len(words := take.split("_")) == 2 and words[1].startswith("light")]
    return [PairSample(folder, i, name, light) for i in range(cameras) for name, light in alone]


def find_defect(sample: PairSample) -> str | None:
    """Describe the first missing, broken, empty, black or clipped picture of a pair in one line, or return None."""
    target_path, background_path = sample.path(sample.object), sample.path("background")
    mask_path, relit_path = sample.path(sample.object, "mask"), sample.path(f"{sample.object}_{sample.light}")
    try:
        target, background, mask = read_rgb(target_path), read_rgb(background_path), read_rgb(mask_path)[..., 0]
        relit = read_straight_rgb(relit_path)
    except ValueError as error:
        return str(error)
    luma, inside = target.mean(-1), mask > 0.5
    covered, clipped = float(inside.float().mean()), float((luma > 0.995).float().mean())
    mean, deviation = float(luma.mean()), float(luma.std())
    level = f"mean {mean:.3f}, deviation {deviation:.3f}"
    far = torch.nn.functional.max_pool2d(mask[None, None], 31, 1, 15)[0, 0] < 0.01
    difference = float((target - background)[far].abs().median()) if bool(far.any()) else 0.0
    lit = float(relit[inside].mean()) if covered else 0.0
    # thresholds set by hand on rendered pairs
    checks = (
        (0.002 <= covered <= 0.7, mask_path, "a mask of 0.2% to 70%", f"{covered:.2%}"),
        (mean > 0.02 and deviation > 0.01, target_path, "a lit picture", level),
        (clipped <= 0.4, target_path, "at most 40% clipped", f"{clipped:.0%}"),
        (lit > 0.01, relit_path, "a lit object", f"mean {lit:.3f}"),
        (difference <= 0.08, background_path, "the target's scene", f"a median difference of {difference:.3f}"),
    )
    wrong = (f"{path}: expected {expected}, found {found}" for sound, path, expected, found in checks if not sound)
    return next(wrong, None)


def write_manifest(out: Path, folders: Sequence[Path]) -> tuple[int, list[str]]:
    """Check every pair, write manifest.jsonl, and return the number of sound pairs and the defects of the others."""
    defects, lines = [], []
    for folder in folders:
        provenance = json.loads((folder / "job.json").read_text(encoding="utf-8")).get("provenance", {})
        for sample in samples_in(folder):
            if defect := find_defect(sample):
                defects.append(defect)
                continue
            entry = {"folder": folder.name, "camera": sample.camera, "object": sample.object, "light": sample.light}
            lines.append(json.dumps({**entry, **provenance}) + "\n")
    with atomic_write(out / "manifest.jsonl") as stream:
        stream.write("".join(lines).encode())
    return len(lines), defects


def read_manifest(out: Path) -> list[PairSample]:
    """Read the sound pairs of a folder from its manifest."""
    path = out / "manifest.jsonl"
    if not path.is_file():
        raise ValueError(f"{path}: expected the manifest of rendered pairs, found none (splatgraft paper synth pairs)")
    samples = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            entry = json.loads(line)
            samples.append(PairSample(out / entry["folder"], int(entry["camera"]), entry["object"], entry["light"]))
        except (ValueError, KeyError, TypeError) as error:
            wanted = "folder, camera, object and light"
            raise ValueError(f"{path}, line {number}: expected {wanted}, found {line[:80]}") from error
    return samples


def check_pairs(out: Path, failures: list[str], console: Console) -> int:
    """Check all rendered scenes in `out` and write the manifest and the failures; return 1 if there are any, else 0."""
    folders = sorted(path.parent for path in out.glob("*/job.json"))
    if not folders and not failures:
        raise ValueError(f"{out}: expected rendered pairs or benchmark scenes, found none")
    count, faults = write_manifest(out, folders)
    console.say(f"{count} sound pairs in {len(folders)} scenes; {len(failures)} scenes failed, {len(faults)} faults")
    write_failures(out, [*failures, *faults], console)
    if folders:
        console.result(out / "manifest.jsonl")
    return 1 if failures or faults else 0
