"""Tiny renders by Blender: Eq. 2, masks and depth against poses, shadows, defects, interruptions, the light probe.

Blender lives in an environment of its own (`make blender`), named by SPLATGRAFT_BLENDER_PYTHON; `.ci/run` sets it.
"""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from splatgraft.core.images import linear_from_srgb, read_rgb
from splatgraft.formats import read_capture
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft_paper.benchmark.true_light import light_from_probe
from splatgraft_paper.synthesis import benchmark, pairs
from splatgraft_paper.synthesis.jobs import Job, RenderSize, Take, check_blender, render_job
from splatgraft_paper.synthesis.places import make_scene
from splatgraft_paper.synthesis.scene import Camera, Lamp, Material, Part, Place, Scene, World

PYTHON = Path(os.environ.get("SPLATGRAFT_BLENDER_PYTHON", "no-blender"))
pytestmark = pytest.mark.skipif(
    "SPLATGRAFT_BLENDER_PYTHON" not in os.environ, reason="SPLATGRAFT_BLENDER_PYTHON names no Python with bpy"
)
TINY = RenderSize(width=96, height=64, samples=2)
WHITE, GREY = Material("plain", (0.8, 0.8, 0.8)), Material("plain", (0.4, 0.4, 0.4))


def floor_scene(*, lamps=(), world=None):
    """Return a grey floor at z = 0 under dim even light."""
    floor = Part("box", (8, 8, 0.1), (0, 0, -0.05), GREY)
    return Scene(
        name="floor",
        kind="floor",
        parts=(floor,),
        lamps=tuple(lamps),
        world=world or World("color", color=(1.0, 1.0, 1.0), strength=0.3),
        places=(Place((0.0, 0.0, 0.0), 0.5, 1.0),),
        bounds=((-4, -4, 0.05), (4, 4, 4)),
    )


def ball(center, radius=0.12):
    return Part("sphere", (2 * radius, 2 * radius, 2 * radius), center, WHITE)


def rendered(job, out):
    render_job(job, out, PYTHON)
    return out


@pytest.fixture(scope="module")
def pair_folder(tmp_path_factory):
    """Render scene 0 of the training pairs: five cameras, one object, one light."""
    out = tmp_path_factory.mktemp("pairs")
    job = pairs.plan(pairs.PairPlan(objects=1, lights=1, size=TINY), 0)
    return rendered(job, out / pairs.job_folder_name(job))


def test_an_interpreter_without_bpy_is_refused():
    assert check_blender(PYTHON).startswith("4.")
    with pytest.raises(ValueError, match="expected a Python with bpy"):
        check_blender(Path("/bin/false"))


@pytest.mark.long
def test_rendered_pairs_are_sound_and_show_the_same_scene_with_and_without_the_object(pair_folder):
    samples = pairs.samples_in(pair_folder)
    assert len(samples) == 5
    assert [pairs.find_defect(sample) for sample in samples] == [None] * 5


@pytest.mark.long
def test_masks_and_depths_lie_where_the_poses_project_known_points(tmp_path):
    centers, radius = ((0.5, 0.2, 0.4), (-0.4, -0.3, 0.25), (0.1, 0.6, 0.9)), 0.12
    cameras = (Camera((2.2, -1.4, 1.3), (0, 0, 0.4), 0.9), Camera((-1.0, -2.5, 0.8), (0.1, 0.1, 0.5), 1.2))
    passes = ("color", "mask", "depth")
    size = RenderSize(width=160, height=120, samples=16)
    takes = tuple(Take(f"ball{i}", scene=True, object=f"ball{i}", passes=passes) for i in range(3))
    things = {f"ball{i}": (ball(center, radius),) for i, center in enumerate(centers)}
    out = rendered(Job(floor_scene(), things, cameras, takes, size), tmp_path / "out")
    poses = benchmark.rendered_cameras(out, ("0000.png", "0001.png"))
    for i, center in enumerate(centers):
        for view in range(2):
            in_camera = torch.linalg.inv(poses.world_from_camera[view]) @ torch.tensor([*center, 1.0])
            u, v = (poses.intrinsics[view] @ in_camera[:3] / in_camera[2])[:2].tolist()
            mask = read_rgb(out / f"ball{i}" / f"{view:04d}_mask.png")[..., 0].numpy()
            rows, columns = np.mgrid[: size.height, : size.width] + 0.5
            found = np.array([(columns * mask).sum(), (rows * mask).sum()]) / mask.sum()
            # a ball's image is an ellipse whose centre lies off the projected centre by under
            # (r / z)^2 / 2 times the offset from the axis (80 px): 0.25 px; 16 samples of the edge give 0.1 px more
            assert np.abs(found - [u, v]).max() < 0.35
            depth = np.load(out / f"ball{i}" / f"{view:04d}_depth.npy")[int(v), int(u)]
            distance = float(in_camera[:3].norm())
            front = in_camera[2].item() * (1 - radius / distance)
            # float16 at 3 m steps by 0.002; the pixel's own ray misses the centre's by half a pixel
            assert abs(depth - front) < 0.01


@pytest.mark.long
def test_a_scene_lit_from_the_left_has_its_shadow_on_the_right(tmp_path):
    # the camera is at -y and looks along +y, so +x is right in the picture
    cameras = (Camera((0, -3, 1.6), (0, 0, 0.2), 0.9),)
    takes = (Take("without", scene=True), Take("with", scene=True, object="ball", passes=("color", "mask")))
    sides = {}
    for side, x in (("left", 1.0), ("right", -1.0)):
        sun = Lamp("sun", (1.0, 1.0, 1.0), 3.0, direction=(x, 0, -1), size=0.01)
        job = Job(floor_scene(lamps=[sun]), {"ball": (ball((0, 0, 0.3), 0.25),)}, cameras, takes, TINY)
        out = rendered(job, tmp_path / side)
        before, after = (linear_from_srgb(read_rgb(out / take / "0000.png")).mean(-1) for take in ("without", "with"))
        mask = read_rgb(out / "with" / "0000_mask.png")[..., 0]
        shadow = (after < 0.7 * before) & (mask < 0.01)
        columns = torch.arange(TINY.width).float().expand_as(mask)
        sides[side] = float(columns[shadow].mean() - (columns * mask).sum() / mask.sum())
        assert int(shadow.sum()) > 20
    # the shadow of a ball 0.3 m up under a sun at 45 degrees lies 0.3 m aside: some 10 of 96 pixels
    assert sides["left"] > 4
    assert sides["right"] < -4


@pytest.mark.long
def test_a_killed_job_goes_on_where_it_was_and_ends_the_same(tmp_path):
    job = pairs.plan(pairs.PairPlan(objects=1, lights=1, size=RenderSize(64, 48, 2)), 5)
    whole = rendered(job, tmp_path / "whole")
    command = "import sys, pickle, splatgraft_paper.synthesis.jobs as j; j.render_job(*pickle.load(sys.stdin.buffer))"
    out = tmp_path / "killed"
    worker = subprocess.Popen([sys.executable, "-c", command], stdin=subprocess.PIPE, start_new_session=True)
    assert worker.stdin is not None
    worker.stdin.write(pickle.dumps((job, out, PYTHON)))
    worker.stdin.close()
    deadline = time.monotonic() + 120
    while not list(out.glob("background/*.done")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(worker.pid, signal.SIGKILL)
    worker.wait()
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/*.done")}
    assert kept
    assert not job.is_done(out)
    render_job(job, out, PYTHON)
    assert job.is_done(out)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    for path in whole.glob("*/*.png"):
        assert (out / path.relative_to(whole)).read_bytes() == path.read_bytes(), path.name
    assert not list(out.rglob("*.partial"))


@pytest.mark.long
def test_a_job_that_blender_cannot_render_says_so_in_a_line(tmp_path):
    dark = World("environment", path=str(tmp_path / "absent.exr"))
    job = Job(replace(floor_scene(), world=dark), {}, (Camera((0, -3, 1), (0, 0, 0)),), (Take("a", True),), TINY)
    failures = run_tasks([Task("a", partial(render_job, job, tmp_path / "out", PYTHON))])
    assert len(failures) == 1
    assert "render.log: expected Blender to render every picture" in failures[0]
    assert "absent.exr" in failures[0]


@pytest.mark.long
def test_a_benchmark_scene_is_laid_out_sound_with_its_true_light(tmp_path):
    which = benchmark.SCENES[6]
    size = benchmark.BenchmarkSize(replace(TINY, samples=1), 3)
    target, source = benchmark.plan(which, size)
    folders = tmp_path / "target", tmp_path / "source"
    for job, folder in zip((target, source), folders, strict=True):
        render_job(job, folder, PYTHON)
    out = tmp_path / which.name
    benchmark.gather(which, *folders, out)
    assert benchmark.find_defect(out) is None
    truth, place = read_capture(out / "ground_truth"), make_scene(which.kind, which.seed).places[0]
    assert truth.cameras.names == read_capture(out / "target").cameras.names
    # sparse points lie on surfaces, also on the support under the object, within noise (0.2% of 3 m)
    points = read_capture(out / "target").points
    top = points[(points[:, :2] - torch.tensor(place.location[:2])).norm(dim=1) < place.radius, 2]
    assert abs(float(top.median()) - place.location[2]) < 0.03
    record = json.loads((out / "scene.json").read_text())
    towards = torch.tensor([float(x) for x in record["sun_direction"].split()])
    light = light_from_probe(
        torch.from_numpy(np.load(out / "probe.npy")).float(), json.loads((out / "suns.json").read_text())
    )
    found = torch.tensor(light.sources[0].direction)
    # the sun is written with five digits
    assert float(found @ towards / towards.norm()) > 1 - 1e-4
    assert np.load(out / "old_light" / "0000.npy").min() >= 0
    surface = np.load(out / "surface.npy")
    assert np.allclose(np.linalg.norm(surface[:, 3:], axis=1), 1, atol=1e-5)  # float32
    # its normals point outward: mostly away from the object's axis
    flat = surface[:, :2] - place.location[:2]
    assert (flat * surface[:, 3:5]).sum(1).mean() > 0
    assert abs(float(surface[:, 2].min()) - place.location[2]) < 0.03  # a blob is sunk by 4% of its height


@pytest.mark.long
def test_a_sun_behind_a_wall_is_no_light_at_the_place_though_an_object_stands_around_the_probe(tmp_path):
    sun = Lamp("sun", (1.0, 1.0, 1.0), 3.0, direction=(1, 0, -1), size=0.01)
    open_air = floor_scene(lamps=[sun])
    wall = Part("box", (0.1, 6, 3), (-1, 0, 1.5), GREY)
    behind = replace(open_air, parts=(*open_air.parts, wall))
    suns = []
    for name, scene in (("open", open_air), ("behind", behind)):
        things = {"ball": (ball((0, 0, 0.3), 0.25),)}
        takes = (Take("without", scene=True), Take("light", scene=True, probe=(0.0, 0.0, 0.3)))
        out = rendered(Job(scene, things, (Camera((0, -3, 1.6), (0, 0, 0.2)),), takes, TINY), tmp_path / name)
        suns.append(json.loads((out / "light" / "suns.json").read_text()))
    assert len(suns[0]) == 1
    assert suns[1] == []


def test_a_sun_lamp_is_listed_and_its_disc_is_not_in_the_panorama(tmp_path):
    sun = Lamp("sun", (1.0, 1.0, 1.0), 3.0, direction=(1, 0, -1), size=0.03)
    takes = (Take("without", scene=True), Take("light", scene=True, probe=(0.0, 0.0, 0.3)))
    job = Job(floor_scene(lamps=[sun]), {}, (Camera((0, -3, 1.6), (0, 0, 0.2)),), takes, TINY)
    out = rendered(job, tmp_path / "out")
    assert len(json.loads((out / "light" / "suns.json").read_text())) == 1
    panorama = np.load(out / "light" / "0000.npy")
    # the upper half is an even sky: only noise makes a pixel brighter than the others
    sky = panorama[:28].max(-1)
    assert sky.max() < 1.5 * np.median(sky)
