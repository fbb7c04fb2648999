"""Methods of the benchmark: light transfer, harmoniser and consolidation, or pictures of another program."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import torch

from splatgraft.core.gaussians import concatenate
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import held_out
from splatgraft.folders.composite_folder import placement_files, read_composite
from splatgraft.formats import read_cameras, read_capture, read_gaussians, write_gaussians
from splatgraft.harmonization import HarmonizerOptions, NoneOptions
from splatgraft.project.layout import LIGHT_FILE, OBJECT_FILE, PLACEMENT_FILE, SCENE_FILE
from splatgraft.project.placement import read_placement
from splatgraft.project.step import Context, Device, Inputs
from splatgraft.relighting import SourceScene, relight
from splatgraft.relighting.light.light import light_to_json
from splatgraft.runtime.console import Console
from splatgraft.steps import harmonize
from splatgraft.steps.relight import Relight
from splatgraft.steps.render import Render
from splatgraft_paper.benchmark.gain import relight_by_gain
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY, ComposedScene, Pipeline, perform_if_stale
from splatgraft_paper.benchmark.transplat import relight_by_irradiance_ratio
from splatgraft_paper.benchmark.true_light import read_true_light
from splatgraft_paper.commands import consolidate
from splatgraft_paper.peers.deferred_reflection import FitOptions, fit_reflections, insert
from splatgraft_paper.peers.methods import OptionWords, named_options

Prior = Literal["off", "paper", "3dgs-dr", "gain", "transplat", "transfer", "true-light"]
Loss = Literal["fourier", "l1-dssim", "lpips", "paper", "paper-l1-dssim"]
Schedule = Literal["once", "linear", "geometric"]
UPDATES = 5
"""Number of harmonisations of a schedule (paper, Iterative Dataset Update)."""
_NAMES = {"copy-paste": "off", "reinhard": "off+reinhard", "flux": "off+flux"}
_GRAMMAR = "PRIOR[+HARMONIZER][/LOSS][@SCHEDULE][:KEY=VALUE,..], NAME=FOLDER, or " + ", ".join(_NAMES)


@dataclass(frozen=True)
class Harmonize(harmonize.Harmonize):
    """The step, extended by the methods of other projects, which the command line does not offer."""

    method: HarmonizerOptions = field(default_factory=NoneOptions)  # pyright: ignore[reportIncompatibleVariableOverride]
    """Options of the method."""


@dataclass(frozen=True)
class Consolidate(consolidate.Consolidate):
    """The step, extended by updates with the methods of other projects."""

    harmonizer: HarmonizerOptions = field(default_factory=NoneOptions)
    """Method that harmonised the views; updates use it again."""

    def harmonizer_options(self) -> HarmonizerOptions:
        """Return the method that harmonised the views."""
        return self.harmonizer


@dataclass(frozen=True)
class Method:
    """One method, parsed from its name on the command line."""

    name: str
    prior: Prior = "off"
    """Light transfer in 3D: none, none on the paper's composite, reflections of the target's environment (3DGS-DR),
    exposure alone, TranSplat's, the physical one, or that with the true light."""
    harmonizer: str | None = None
    """Image model; without one, the prior is the result."""
    loss: Loss = "fourier"
    """Loss of the consolidation. `paper` is 10,000 steps of Adam on LPIPS alone; `paper-l1-dssim` replaces LPIPS by the
    loss of 3DGS (paper, Perceptual vs Photometric Loss)."""
    schedule: Schedule = "once"
    """Schedule by which views are harmonised again from the consolidated scene (paper, Iterative Dataset Update)."""
    options: tuple[tuple[str, str], ...] = ()
    """The harmoniser's own options."""
    pictures: Path | None = None
    """Folder of another program's results: SCENE/VIEW.png, named as the views of the ground truth, or numbered."""

    @staticmethod
    def parse(text: str) -> "Method":
        """Parse `transfer+flux/l1-dssim@linear`, `off+lbm:weights=FOLDER` or `lbm=results/lbm`."""
        if "=" in text.partition(":")[0]:
            name, folder = text.split("=", 1)
            if not name or not Path(folder).is_dir():
                raise ValueError(f"--methods: expected NAME=FOLDER with an existing folder, found {text}")
            return Method(name=name, pictures=Path(folder))
        words = OptionWords.parse(text)
        rest, _, schedule = _NAMES.get(words.name, words.name).partition("@")
        rest, _, loss = rest.partition("/")
        prior, _, harmonizer = rest.partition("+")
        if prior == "paper":  # the paper's pipeline whole (its Sec. 4 to 6)
            harmonizer, loss = harmonizer or "flux", loss or "paper"
        loss, schedule = loss or "fourier", schedule or "once"
        if prior not in get_args(Prior) or loss not in get_args(Loss) or schedule not in get_args(Schedule):
            raise ValueError(
                f"--methods: expected {_GRAMMAR} with PRIOR of {', '.join(get_args(Prior))}, LOSS of "
                f"{', '.join(get_args(Loss))}, SCHEDULE of {', '.join(get_args(Schedule))}; found {text}"
            )
        if not harmonizer and (loss, schedule) != ("fourier", "once"):
            raise ValueError(f"--methods: expected a harmonizer where a loss or a schedule is named, found {text}")
        if prior == "3dgs-dr" and harmonizer:
            raise ValueError(f"--methods: expected no harmonizer after 3dgs-dr, which gives pictures, found {text}")
        if words.options and not harmonizer:
            raise ValueError(f"--methods: expected a harmonizer where options are given, found {text}")
        return Method(text, prior, harmonizer or None, loss, schedule, words.options)  # pyright: ignore[reportArgumentType]

    @property
    def pipeline(self) -> Pipeline:
        """Pipeline that makes the composite."""
        return "paper" if self.prior == "paper" else "ours"

    @property
    def folder_name(self) -> str:
        """Name without the characters that a folder's name cannot contain, and a hash of the options."""
        return OptionWords(self.name.partition(":")[0], self.options).folder_name


@dataclass(frozen=True)
class RelightForBenchmark:
    """A light transfer for comparison, which only the benchmark has.

    - gain: one factor for each object and channel, from the mean light around both places; no shadow.
    - transplat: TranSplat's ratio of the irradiances at both places, for each normal; no shadow.
    - true-light: the physical transfer with the true light instead of an estimate, an upper bound for the estimate.
    """

    target: Path
    """The target scene, a .ply."""
    placement: Path
    """The composite's placement file."""
    cameras: Path
    """Cameras of the target."""
    surroundings: Path
    """Source scene without the object, a .ply."""
    object_cameras: Path
    """Cameras of the source."""
    out: Path
    """Folder for scene.ply."""
    prior: Literal["gain", "transplat", "true-light"]
    """The transfer."""
    light: Path | None = None
    """File light.json with the true light."""

    def inputs(self) -> Inputs:
        """List all files that are read."""
        rest = (self.cameras, self.object_cameras, *((self.light,) if self.light else ()))
        scenes = (self.target, self.surroundings)
        return {"scenes": scenes, "placement": placement_files(self.placement), "rest": rest}

    def write(self, folder: Path, context: Context) -> None:
        """Write the relit composite."""
        source = SourceScene(read_gaussians(self.surroundings), read_cameras(self.object_cameras))
        composite = read_composite(self.target, self.placement)
        if self.prior == "gain":
            result, notes = relight_by_gain(composite, read_cameras(self.cameras), sources=[source])
        elif self.prior == "transplat":
            result, notes = relight_by_irradiance_ratio(composite, sources=[source])
        else:
            assert self.light is not None
            light, cameras = read_true_light(self.light), read_cameras(self.cameras)
            result = relight(composite, cameras, sources=[source], light=light)
            notes = result.report
            if result.light is not None:
                (folder / LIGHT_FILE).write_text(light_to_json(result.light), encoding="utf-8")
        write_gaussians(folder / SCENE_FILE, result.bake()[0])
        context.console.tell(*notes)


@dataclass(frozen=True)
class ReflectForBenchmark:
    """3DGS-DR, extended to insertion: pictures of the object under an environment fitted to the target's photos."""

    target: Path
    """The target scene, a .ply."""
    object: Path
    """The object, a .ply in the frame of its capture."""
    surroundings: Path
    """Source scene without the object, a .ply."""
    placement: Path
    """File placement.json with the object's pose."""
    source_capture: Path
    """Photos of the object."""
    target_capture: Path
    """Photos of the target, without the held-out ones."""
    views: Path
    """Capture or file of cameras, whose every 8th view is pictured."""
    out: Path
    """Folder for VIEW.png."""
    options: FitOptions = field(default_factory=FitOptions)

    def inputs(self) -> Inputs:
        """List all files that are read."""
        photos = [*read_capture(self.source_capture).image_paths, *read_capture(self.target_capture).image_paths]
        scenes = (self.target, self.object, self.surroundings)
        return {"scenes": scenes, "photos": tuple(photos), "placement": placement_files(self.placement)}

    def write(self, folder: Path, context: Context) -> None:
        """Fit both scenes, insert the object and write the pictures."""
        taken, rest = read_gaussians(self.object), read_gaussians(self.surroundings)
        source = fit_reflections(concatenate([rest, taken]), read_capture(self.source_capture), self.options)
        found = source.select(torch.arange(source.gaussians.count) >= rest.count)
        move = read_placement(self.placement).objects[0].target_from_object
        target = fit_reflections(read_gaussians(self.target), read_capture(self.target_capture), self.options)
        whole = insert(target, [replace(found, gaussians=move.gaussians(found.gaussians))])
        cameras = read_cameras(self.views)
        for index in torch.nonzero(held_out(len(cameras), HELD_OUT_EVERY)).flatten().tolist():
            picture = whole.picture(cameras[index]).clamp(0, 1)
            write_image(folder / f"{Path(cameras.names[index]).stem}.png", picture)
            context.progress(index + 1, len(cameras), cameras.names[index])


@dataclass(frozen=True)
class MethodSettings:
    """Settings that all methods of a run share."""

    weights: Path | None = None
    """Folder with LPIPS's weights."""
    model: str | None = None
    """Weights of the harmoniser: folder, file or hub id."""
    device: Device = "auto"
    iterations: int = 10_000
    """Steps of the paper's consolidation."""
    reflections: FitOptions = field(default_factory=FitOptions)
    """Fits of 3DGS-DR."""


def run_method(
    method: Method,
    scene: ComposedScene,
    settings: MethodSettings,
    console: Console,
) -> tuple[Path, dict[str, float]]:
    """Run the stale steps of a method, and return its scene and the seconds of each of its own steps.

    The scene is a .ply; for 3DGS-DR, which shades after rasterising, it is a folder of pictures of the held-out views.
    """
    seconds: dict[str, float] = {}
    if method.prior == "3dgs-dr":
        step = _reflections(scene, settings)
        seconds["reflect"] = perform_if_stale(step, console)
        return step.out, seconds
    prior = scene.composite / SCENE_FILE
    if method.prior not in ("off", "paper"):
        prior, seconds["relight"] = _relit_scene(method.prior, scene, console)
    if method.harmonizer is None:
        return prior, seconds
    words = OptionWords(method.harmonizer, method.options)
    options = named_options(words, weights=settings.model)
    result = scene.work / "methods" / method.folder_name / "result"
    views = scene.work / "views" / method.prior
    composite = scene.composite / SCENE_FILE
    render = Render(composite, scene.cameras, views, is_object=scene.is_object, prior=prior, device=settings.device)
    seconds["render"] = perform_if_stale(render, console)
    harmonized = scene.work / "harmonized" / f"{method.prior}+{words.folder_name}"
    step = Harmonize(views, harmonized, options, device=settings.device)
    seconds["harmonize"] = perform_if_stale(step, console)
    step = Consolidate(
        prior, views, harmonized, result, lpips_weights=settings.weights, device=settings.device, harmonizer=options
    )
    if method.loss.startswith("paper"):
        loss = "l1-dssim" if method.loss == "paper-l1-dssim" else None
        step = replace(step, loss=loss, iterations=settings.iterations)
    else:
        step = replace(step, method="fast", loss=method.loss)
    if method.schedule != "once":
        step = replace(step, updates=UPDATES, schedule=method.schedule)
    seconds["consolidate"] = perform_if_stale(step, console)
    return result / SCENE_FILE, seconds


def _reflections(scene: ComposedScene, settings: MethodSettings) -> ReflectForBenchmark:
    if scene.surroundings is None or scene.source_cameras is None or scene.views is None:
        raise ValueError(f"{scene.name}: 3dgs-dr: expected the captures of the object and of the target, found none")
    return ReflectForBenchmark(
        scene.target,
        scene.work / "object" / OBJECT_FILE,
        scene.surroundings,
        scene.composite / PLACEMENT_FILE,
        scene.source_cameras.parent,
        scene.cameras.parent,
        scene.views,
        scene.work / "pictures" / "3dgs-dr",
        settings.reflections,
    )


def _relit_scene(prior: Prior, scene: ComposedScene, console: Console) -> tuple[Path, float]:
    out = scene.work / "priors" / prior
    placement = scene.composite / PLACEMENT_FILE
    if prior in ("gain", "transplat", "true-light"):
        light = scene.light if prior == "true-light" else None
        if scene.surroundings is None or scene.source_cameras is None or (prior == "true-light" and light is None):
            raise ValueError(f"{scene.name}: {prior}: expected the object's capture and a true light, found none")
        step = RelightForBenchmark(
            scene.target, placement, scene.cameras, scene.surroundings, scene.source_cameras, out, prior, light
        )
        return out / SCENE_FILE, perform_if_stale(step, console)
    step = Relight(scene.target, placement, scene.cameras, out)
    step = replace(step, surroundings=scene.surroundings, object_cameras=scene.source_cameras)
    return out / SCENE_FILE, perform_if_stale(step, console)
