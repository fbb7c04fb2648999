"""Light of meshes: rendered truth of six kinds (blender_meshes.py) in scenes of `paper exam`, against the relit scene.

    python benchmarks/mesh.py SCENE... --work WORK... --out OUT --blender-python PYTHON
    python benchmarks/mesh.py --draw NUMBER --kinds kitchen garden --out OUT --blender-python PYTHON

A SCENE is a folder with target/, probe.npy, suns.json and scene.json; WORK/target/scene is its reconstruction. --draw
draws and renders new scenes, which are used once. Rows: pasted (base colours as they are), the given (true) light, the
estimated light. PSNR of the object's pixels, and error of the shadow's ratio, in views outside the reconstruction.
--scale makes these pictures larger than the captured ones.
"""

import argparse
import json
import math
import subprocess
from dataclasses import replace
from pathlib import Path

import torch

from splatgraft.composition import compose
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_rgb, write_image
from splatgraft.core.posed_images import held_out
from splatgraft.core.similarity import Similarity
from splatgraft.evaluation import Truth
from splatgraft.formats import read_cameras, read_capture, read_gaussians, read_scene, write_capture
from splatgraft.project.step import perform
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.relighting import relight
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.steps.reconstruct import Reconstruct
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY
from splatgraft_paper.benchmark.true_light import read_probe
from splatgraft_paper.exam.measure import light_errors, measure_row
from splatgraft_paper.exam.scenes import SIZE, TrueView, draw_scenes
from splatgraft_paper.synthesis import benchmark
from splatgraft_paper.synthesis.jobs import Job, Model, Take, render_job
from splatgraft_paper.synthesis.places import make_scene
from splatgraft_paper.synthesis.scene import Camera, Place

KINDS = ("matte", "glossy", "metal", "painted", "thin", "concave")
VIEWS = 2  # held-out views of each scene
BLENDER_FROM_RDF = torch.tensor([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
"""Rotation from the axes in which a mesh is read to those in which Blender's importer places it."""


def height_at(place: Place) -> float:
    """Return the height of a mesh in metres; the meshes are as wide as high, or less."""
    return min(1.6 * place.radius, 0.8 * place.height)


def drawn_scene(which: benchmark.BenchmarkScene, out: Path, python: Path) -> tuple[Path, Path]:
    """Render the target and the light of a drawn scene, reconstruct it, and return its folders."""
    folder, work, rendered = out / "scenes" / which.name, out / "work" / which.name, out / "renders" / which.name
    job = benchmark.plan(which, SIZE)[0]
    render_job(replace(job, takes=tuple(take for take in job.takes if take.name != "ground_truth")), rendered, python)
    benchmark.gather_capture(rendered, "target", folder / "target", passes=("images",), points=True)
    for given, name in (("0000.npy", "probe.npy"), ("suns.json", "suns.json")):
        (folder / name).write_bytes((rendered / "light" / given).read_bytes())
    (folder / "scene.json").write_text(json.dumps({"kind": which.kind, "seed": which.seed}))
    return folder, work


def reconstructed(folder: Path, work: Path) -> Gaussians:
    """Read the target's reconstruction without the held-out views; it is made if it does not exist."""
    scene = work / "target" / "scene" / "scene.ply"
    if not scene.is_file():
        capture = read_capture(folder / "target")
        (work / "target" / "capture").mkdir(parents=True, exist_ok=True)
        write_capture(work / "target" / "capture", capture.select(~held_out(len(capture), HELD_OUT_EVERY)))
        options = ReconstructOptions(iterations=1000, budget=20_000)
        perform(Reconstruct(work / "target" / "capture", scene.parent, options=options), Console())
    return read_gaussians(scene)


def true_pictures(folder: Path, cameras: Cameras, options: argparse.Namespace) -> tuple[Path, list[int]]:
    """Render held-out views without and with each mesh; returns the takes' folder and the views' numbers."""
    record = json.loads((folder / "scene.json").read_text())
    scene = make_scene(record["kind"], record["seed"])
    place, meshes = scene.places[0], options.out / "meshes"
    chosen = held_out(len(cameras), HELD_OUT_EVERY).nonzero()[:VIEWS, 0].tolist()
    # the first take gives the exposure, as in the scene's own pictures
    takes = [Take("without", scene=True)]
    takes += [Take(kind, scene=True, object=kind, passes=("color", "mask")) for kind in KINDS]
    rendered = options.out / "truth" / folder.name
    for take in takes:  # other views count as done
        (rendered / take.name).mkdir(parents=True, exist_ok=True)
        for index in set(range(len(cameras))) - set(chosen):
            (rendered / take.name / f"{index:04d}.done").touch()
    models = {kind: Model(str((meshes / f"{kind}.glb").resolve()), height_at(place), place.location) for kind in KINDS}
    width, height = cameras.sizes[0].tolist()
    size = replace(SIZE.render, width=width, height=height)
    render_job(Job(scene, models, _blender_cameras(cameras), tuple(takes), size), rendered, options.blender_python)
    return rendered, chosen


def _blender_cameras(cameras: Cameras) -> tuple[Camera, ...]:
    found = []
    for pose, intrinsics, size in zip(cameras.world_from_camera, cameras.intrinsics, cameras.sizes, strict=True):
        eye = pose[:3, 3]
        field = 2 * math.atan(float(size[0] / 2 / intrinsics[0, 0]))
        found.append(Camera(tuple(eye.tolist()), tuple((eye + pose[:3, 2]).tolist()), field))
    return tuple(found)


def measured(folder: Path, work: Path, options: argparse.Namespace) -> dict:
    """Measure all kinds in a scene, and write a picture: pasted, given light, estimated light, truth."""
    target, captured = reconstructed(folder, work), read_cameras(folder / "target")
    fitted = captured[~held_out(len(captured), HELD_OUT_EVERY)]
    cameras, meshes = captured.resized(options.scale), options.out / "meshes"
    light = read_probe(folder / "probe.npy", folder / "suns.json")
    record = json.loads((folder / "scene.json").read_text())
    place = make_scene(record["kind"], record["seed"]).places[0]
    at, found, notes = torch.tensor(place.location), {}, []
    rendered, chosen = true_pictures(folder, cameras, options)
    for kind in KINDS:
        views = []
        for index in chosen:
            image, without = (read_rgb(rendered / take / f"{index:04d}.png") for take in (kind, "without"))
            mask = read_rgb(rendered / kind / f"{index:04d}_mask.png")[..., 0]
            drawn = render(target, cameras[index]).color[0].clamp(0, 1)
            views.append(TrueView(cameras[index], Truth(image=image, background=without, mask=mask), drawn))
        move = Similarity(height_at(place), BLENDER_FROM_RDF, at)
        composite = compose(
            target,
            [read_scene(meshes / f"{kind}.glb", mesh_budget=options.budget).gaussians],
            target_from_objects=[move],
        )
        scenes = {"pasted": composite.bake()[0]}
        for name, given in (("given", light), ("estimated", None)):
            relit = relight(composite, fitted, light=given)
            scenes[name] = relit.bake()[0]
        notes.append({kind: [note.text for note in relit.report]})
        found[kind] = {name: measure_row(scene, views) for name, scene in scenes.items()}
        assert relit.light is not None
        found[kind]["light"] = light_errors(relit.light, light)
        columns = [torch.cat([view.picture(scene) for view in views], 0) for scene in scenes.values()]
        truth = torch.cat([view.truth.image for view in views], 0)
        write_image(options.out / "pictures" / f"{folder.name}_{kind}.png", torch.cat([*columns, truth], 1))
        print(folder.name, kind, json.dumps(found[kind]), flush=True)
    return {"kinds": found, "notes": notes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--work", type=Path, nargs="*", default=[])
    parser.add_argument("--draw", type=int)
    parser.add_argument("--kinds", nargs="*", default=("kitchen", "garden"))
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--scale", type=float, default=2.0, help="width of a picture over that of a captured one")
    parser.add_argument("--budget", type=int, default=60_000, help="number of Gaussians of a mesh")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--blender-python", type=Path, required=True)
    options = parser.parse_args()
    python, out, meshes = options.blender_python, options.out, options.out / "meshes"
    (out / "pictures").mkdir(parents=True, exist_ok=True)
    if not all((meshes / f"{kind}.png").is_file() for kind in KINDS):
        subprocess.run([python, Path(__file__).parent / "blender_meshes.py", meshes], check=False)
    scenes = list(zip(options.scenes, options.work, strict=True))
    if options.draw is not None:
        drawn = draw_scenes(options.draw, options.count, options.kinds)
        scenes += [drawn_scene(which, out, python) for which in drawn]
    results = {}
    for folder, work in scenes:
        results[folder.name] = measured(folder, work, options)
        (out / "mesh.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
