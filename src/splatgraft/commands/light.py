"""The command `light`: the estimated light at a place of a target as an environment map, with or beside its lamps."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_radiance
from splatgraft.folders.clock_sun import read_clock_sun
from splatgraft.folders.composite_folder import read_composite
from splatgraft.formats import is_scene, read_cameras, read_gaussians
from splatgraft.project.layout import CAMERAS_FILE, PROJECT_FILE, SCENE_FILE
from splatgraft.project.step import Positional
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.description import describe_light
from splatgraft.relighting.light.environment import environment_light, place_at, upright_from_capture
from splatgraft.relighting.light.light import light_to_json
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.scene_light import place_of
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.steps.relight import Relight
from splatgraft.workflow.flow import read_flow

_MIN_HEIGHT, _MAX_HEIGHT = 16, 4096  # rows of the map


@dataclass(frozen=True)
class LightAt:
    """Write the light at a place of a target, to light meshes in other programs: an environment map (.hdr) of the
    ambient light and the scene's own radiance, and beside it a .json with the lamps (sun, windows, lamps). Use both:
    the map is without the lamps, so nothing is counted twice. With --lamps map the map has them, and there is no .json.

    The map is equirectangular, as Blender's World expects it: the top row is +z, the middle column +x, columns to the
    right turn towards -y. It holds linear Rec. 709 radiance in the units of the capture, in which a white sky has 1;
    the lamps' irradiance, on a plane that faces the lamp, has the same units: a white sky gives pi. Directions go from
    the place to the lamp, distances are in units of the capture."""

    target: Positional
    """A project (its folder or project.toml); or a scene file or a folder with scene.ply, together with --cameras."""
    out: Path = Path("light.hdr")
    """The environment map."""
    lamps: Literal["file", "map"] = "file"
    """file: the lamps are written beside the map, with the suffix .json, for sharp shadows. map: each lamp is in the
    map, as a disc at least one degree wide with all its energy, so that one file lights a scene in any program."""
    at: tuple[float, float, float] | None = None
    """The place, x y z in the axes and units of the target's capture; the middle of the placed objects if not
    given."""
    radius: float | None = None
    """Half the width of the thing that will stand there, units of the capture; surfaces nearer than half of it are left
    out. If not given, that of the placed objects, or with --at an eighth of the cameras' distance."""
    cameras: Path | None = None
    """The target's cameras, a capture folder or its transforms.json; found in a project."""
    placement: Path | None = None
    """placement.json: its objects give the place, and its erased Gaussians are left out. Found in a project."""
    frame: Literal["world", "capture"] = "world"
    """Axes of the map and of the lamps. world: z is up, as in Blender after it opened the exported .glb. capture: those
    of the target's .ply."""
    height: int = 512
    """Rows of the map, which is twice as wide."""

    def execute(self, console: Console) -> int:
        """Estimate the light, write both files and print their paths."""
        if self.out.suffix.lower() != ".hdr":
            raise ValueError(f"--out: expected a file that ends in .hdr, found {self.out.name}")
        if not _MIN_HEIGHT <= self.height <= _MAX_HEIGHT:
            raise ValueError(f"--height: expected {_MIN_HEIGHT} to {_MAX_HEIGHT} rows, found {self.height}")
        if self.radius is not None and not self.radius > 0:
            raise ValueError(f"--radius: expected a number above 0, found {self.radius:g}")
        step = self._step()
        scene, spheres = _scene_of(step)
        cameras, clock = read_cameras(step.cameras), read_clock_sun(step.cameras)
        captured = CapturedScene(scene, cameras, clock)
        place = self._place(step, spheres, cameras)
        up = captured.up
        turn = torch.eye(3) if self.frame == "capture" else upright_from_capture(up)
        given, through = step.given(), step.options.sun_through
        with console.bar("light"):
            found = environment_light(
                captured, place, map_from_capture=turn, height=self.height, given=given, sun_through=through
            )
        if isinstance(found, NoLight):
            raise ValueError(f"--at: expected a place with light around it, found none. {found.reason}")
        light, lamps = found.light, self.out.with_suffix(".json")
        write_radiance(self.out, found.radiance if self.lamps == "file" else found.with_lamps())
        if self.lamps == "file":
            with atomic_write(lamps) as stream:
                axes = None if self.frame == "capture" else turn
                stream.write(light_to_json(light, world_from_capture=axes).encode())
        console.say(
            f"The light at {', '.join(f'{v:.3g}' for v in place.center.tolist())}: {describe_light(light, up)}."
        )
        if clock is not None:
            console.say(f"By the clock of the target's photos: {clock.describe(cameras)}.")
        console.result(self.out)
        if self.lamps == "file":
            console.result(lamps)
        return 0

    def _step(self) -> Relight:
        """Return the step that would relight the target, for its input files and its given light."""
        root = self.target.parent if self.target.name == PROJECT_FILE else self.target
        if (root / PROJECT_FILE).is_file():
            step = read_flow(root).typed(Relight)
            return replace(step, placement=self.placement or step.placement, cameras=self.cameras or step.cameras)
        scene = self.target if is_scene(self.target) else self.target / SCENE_FILE
        if not scene.exists():
            raise ValueError(
                f"{self.target}: expected a project, a scene or a folder with {SCENE_FILE}, found none of them"
            )
        beside = scene.parent.parent / "capture" / CAMERAS_FILE
        cameras = self.cameras or (beside if beside.is_file() else None)
        if cameras is None:
            raise ValueError(f"--cameras: expected the capture that {scene} was made from, found none")
        return Relight(target=scene, placement=self.placement or Path(), cameras=cameras)

    def _place(self, step: Relight, spheres: list[BoundingSphere], cameras: Cameras) -> BoundingSphere:
        if self.at is None and not spheres:
            raise ValueError(
                f"--at: expected x y z, or a placed object in {step.placement}, found neither; "
                "`splatgraft run PROJECT --to compose` places one"
            )
        if self.at is None:
            found = place_of(spheres)
            return found if self.radius is None else BoundingSphere(found.center, self.radius)
        return place_at(self.at, cameras, self.radius)


def _scene_of(step: Relight) -> tuple[Gaussians, list[BoundingSphere]]:
    """Return the target without erased Gaussians, and the bounding spheres of its placed objects."""
    if not step.placement.is_file():
        return read_gaussians(step.target), []
    composite = read_composite(step.target, step.placement)
    placed = [one.in_target() for one in composite.objects if one.gaussians.count]
    return composite.target.select(~composite.erased), [bounding_sphere(one) for one in placed]


COMMAND = LightAt
