"""Our methods on a scene of the data set: renders of its held-out views.

1. If both scenes are given as trained .ply files, the object has its place already.
2. Otherwise, if there is a placement.json, both captures are reconstructed and it places the object.
3. Otherwise the authors' pasted pictures are reconstructed, and their masks cut the object out at its place. The light
   of its own capture is unknown then, as in the first case.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import read_rgb, write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.similarity import Similarity
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_cameras, read_gaussians, read_scene, write_cameras, write_capture, write_gaussians
from splatgraft.project.layout import METRICS_FILE, OBJECT_FILE, PLACEMENT_FILE, SCENE_FILE
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.steps.render import Render
from splatgraft_paper.benchmark.measure import disagreement
from splatgraft_paper.benchmark.methods import Method, MethodSettings, run_method
from splatgraft_paper.benchmark.scene import (
    ComposedScene,
    CompositionOptions,
    GroundTruthScene,
    compose_scene,
    perform_if_stale,
    place_step,
)
from splatgraft_paper.commands.consolidate import UPDATES_FOLDER
from splatgraft_paper.tables.layout import PaperScene, held_out_stems, pictures


@dataclass(frozen=True)
class OurRun:
    """Settings of our methods."""

    out: Path
    """Folder of all results."""
    composition: CompositionOptions
    """Options of reconstruction and composition."""
    methods: MethodSettings = field(default_factory=MethodSettings)

    @property
    def device(self) -> Device:
        """Device of all steps."""
        return self.methods.device


@dataclass(frozen=True)
class RenderPictures:
    """Renders of a scene from some of its cameras."""

    scene: Path
    """Scene, a .ply."""
    cameras: Path
    """Folder of a capture, or its file of cameras."""
    out: Path
    """Folder for VIEW.png."""
    stems: tuple[str, ...] = ()
    """Names of the views."""
    device: Device = "auto"

    def inputs(self) -> Inputs:
        """List the scene and the files of cameras."""
        return {"scene": (self.scene,), "cameras": camera_files(self.cameras)}

    def write(self, folder: Path, context: Context) -> None:
        """Render the pictures."""
        device = choose_device(self.device, context.console)
        scene, cameras = read_gaussians(self.scene).to(device), read_cameras(self.cameras)
        wanted = [index for index, name in enumerate(cameras.names) if Path(name).stem in self.stems]
        for done, index in enumerate(wanted, 1):
            image = render(scene, cameras[index].to(device)).color[0]
            write_image(folder / f"{Path(cameras.names[index]).stem}.png", image.cpu().clamp(0, 1))
            context.progress(done, len(wanted), cameras.names[index])


@dataclass(frozen=True)
class MeasureAgreement:
    """Disagreement of neighbouring views of a result, and of the truth, warped by the depth of the composite."""

    result: Path
    """Scene, a .ply."""
    views: Path
    """Folder that `Render` wrote for the composite."""
    truth: Path
    """Folder of true pictures."""
    out: Path
    """Folder for metrics.json."""
    device: Device = "auto"

    def inputs(self) -> Inputs:
        """List the scene, the views and the true pictures."""
        views = ViewFolder.open(self.views).files()
        return {"scene": (self.result,), "views": views, "truth": tuple(pictures(self.truth).values())}

    def write(self, folder: Path, context: Context) -> None:
        """Measure both."""
        device = choose_device(self.device, context.console)
        scene, views, given = read_gaussians(self.result).to(device), ViewFolder.open(self.views), pictures(self.truth)
        made, true, depths, masks = {}, {}, [], []
        for index, name in enumerate(views.cameras.names):
            made[index] = render(scene, views.cameras[index].to(device)).color[0].cpu().clamp(0, 1)
            if Path(name).stem in given:
                true[index] = read_rgb(given[Path(name).stem])
            view = views.read(index)
            depths.append(view.depth)
            masks.append(view.mask)
            context.progress(index + 1, len(views), name)
        found = {"disagreement": made, "disagreement_truth": true}
        values = {name: disagreement(images, depths, masks, views.cameras) for name, images in found.items()}
        known = {name: value for name, value in values.items() if value is not None}
        (folder / METRICS_FILE).write_text(json.dumps(known if len(known) == len(found) else {}), encoding="utf-8")


SHOWN_UPDATES = (1, 3, 5)
"""Iterative updates whose result is pictured, as in the paper's figure."""


def updates_folder(scene: Path, method: Method, number: int) -> Path:
    """Return the folder of a picture after an update, in that of the scene's results."""
    return scene / "updates" / method.folder_name / str(number)


@dataclass(frozen=True)
class OurPictures:
    """A method's result on a scene."""

    folder: Path
    """Pictures of the held-out views."""
    seconds: Mapping[str, float]
    """Seconds by step."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Disagreement of neighbouring views, of scenes with rotations."""


def our_pictures(scene: PaperScene, method: Method, run: OurRun, console: Console) -> OurPictures:
    """Run a method's stale steps on a scene."""
    folder = run.out / "scenes" / scene.name
    work = folder / ("" if method.pipeline == "ours" else "as_paper")
    cameras_from = _cameras_path(scene)
    composed = _composed(
        scene, work, replace(run, composition=replace(run.composition, pipeline=method.pipeline)), console
    )
    result, seconds = run_method(method, composed, run.methods, console)
    if result.is_dir():
        return OurPictures(result, {**composed.seconds, **seconds})
    names = [Path(name).stem for name in read_cameras(cameras_from).names]
    stems = tuple(held_out_stems(names))
    out = folder / "pictures" / method.folder_name
    perform_if_stale(RenderPictures(result, cameras_from, out, stems=stems, device=run.device), console)
    for number in SHOWN_UPDATES if method.schedule != "once" else ():
        update = result.parent / UPDATES_FOLDER / str(number - 1) / SCENE_FILE
        shown = updates_folder(folder, method, number)
        middle = (stems[len(stems) // 2],)
        perform_if_stale(RenderPictures(update, cameras_from, shown, stems=middle, device=run.device), console)
    values: Mapping[str, float] = {}
    if scene.kind == "rotation" and "truth" in scene.folders:
        pasted, views = (
            composed.composite / SCENE_FILE,
            work / "views" / ("paper" if method.pipeline == "paper" else "off"),
        )
        render_views = Render(
            pasted, composed.cameras, views, is_object=composed.is_object, prior=pasted, device=run.device
        )
        at = folder / "agreement" / method.folder_name
        for step in (render_views, MeasureAgreement(result, views, scene.folders["truth"], at, run.device)):
            perform_if_stale(step, console)
        values = json.loads((at / METRICS_FILE).read_text(encoding="utf-8"))
    return OurPictures(out, {**composed.seconds, **seconds}, values)


def _cameras_path(scene: PaperScene) -> Path:
    path = scene.files.get("cameras") or scene.files.get("target_capture")
    if path is None:
        raise ValueError(f"{scene.name}: expected transforms.json, found none")
    return path


def _composed(scene: PaperScene, work: Path, run: OurRun, console: Console) -> ComposedScene:
    files = scene.files
    if "target_scene" in files and "object_scene" in files:
        return _placed(scene, work, run, console)
    if {"source_capture", "target_capture", "placement"} <= set(files) and "truth" in scene.folders:
        captures = (files["source_capture"], files["target_capture"])
        truth = GroundTruthScene(scene.name, *captures, scene.folders["truth"], files["placement"])
        return compose_scene(truth, work, run.composition, console)
    if {"composite", "masks"} <= set(scene.folders) and ("background" in scene.folders or "target_capture" in files):
        return _cut_from_pictures(scene, work, run, console)
    found = [path.name for path in (*scene.folders.values(), *files.values())]
    raise ValueError(
        f"{scene.name}: expected background.ply and object.ply, or both captures, gt/ and placement.json, or "
        f"composite/, masks/ and background/; found {', '.join(found) or 'none of them'}"
    )


def _cut_from_pictures(scene: PaperScene, work: Path, run: OurRun, console: Console) -> ComposedScene:
    """Reconstruct the pasted pictures and the background, and cut the object out by its masks, at its place."""
    cameras = read_cameras(_cameras_path(scene))
    given = {}
    for role in ("composite", "background"):
        if role in scene.folders:
            given[role] = work / "given" / role
            given[role].mkdir(parents=True, exist_ok=True)
            write_capture(given[role], _pictured(scene, role, cameras))
    placement = _placement_as_given(work)
    target = given.get("background", scene.files.get("target_capture"))
    assert target is not None
    truth = GroundTruthScene(scene.name, given["composite"], target, target, placement)
    composed = compose_scene(truth, work, replace(run.composition, masks="given"), console)
    return replace(composed, from_capture=False)


def _pictured(scene: PaperScene, role: str, cameras: Cameras) -> PosedImages:
    """Return the pictures of a role with their cameras, and masks and no held-out view for the pasted ones."""
    folders = {name: pictures(scene.folders[name]) for name in (role, *(("masks",) if role == "composite" else ()))}
    stems = [Path(name).stem for name in cameras.names]
    held = held_out_stems(stems) if role == "composite" else ()  # `compose_scene` removes those of the target
    chosen = [stem for stem in stems if stem not in held and all(stem in found for found in folders.values())]
    if not chosen:
        raise ValueError(f"{scene.folders[role]}: expected pictures named like the cameras, {stems[0]}.., found none")
    paths = {name: tuple(found[stem] for stem in chosen) for name, found in folders.items()}
    seen = cameras[torch.tensor([stem in chosen for stem in stems])]
    nothing = torch.zeros(0, 3)
    return PosedImages(paths[role], seen, nothing, nothing, mask_paths=paths.get("masks", ()))


def _placement_as_given(work: Path) -> Path:
    """Write a placement that leaves the object where it is."""
    path = work / "given_placement" / PLACEMENT_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    write_placement(path, Placement((ObjectPlacement(Similarity.identity()),)))
    return path


def _placed(scene: PaperScene, work: Path, run: OurRun, console: Console) -> ComposedScene:
    """Compose trained scenes; the object has its place already, so the placement is the identity."""
    cameras = read_cameras(_cameras_path(scene))
    composed = ComposedScene(scene.name, work, from_capture=False)
    object_file = work / "object" / OBJECT_FILE
    for path in (composed.cameras, composed.target, object_file):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_cameras(composed.cameras, _without_held_out(cameras))
    for key, path in (("target_scene", composed.target), ("object_scene", object_file)):
        given = read_scene(scene.files[key])
        for note in given.notes:
            console.say(f"{scene.files[key]}: {note}")
        write_gaussians(path, given.gaussians)
    placement = _placement_as_given(work)
    perform_if_stale(place_step(run.composition.pipeline, composed, object_file, placement), console)
    return composed


def _without_held_out(cameras: Cameras) -> Cameras:
    """Select the cameras whose views are not held out."""
    held = set(held_out_stems([Path(name).stem for name in cameras.names]))
    return cameras[torch.tensor([Path(name).stem not in held for name in cameras.names])]
