"""Renders the target capture of `splatgraft demo`, src/splatgraft/demo_captures/table: a kitchen table in low sunlight.

    python data/render_table.py build/table --blender-python .venv-blender/bin/python

A room of the generator (kitchen, seed 71000) whose window gets a sun that shines onto the table; 28 cameras around the
table at three heights, 576x400, 20 samples and the denoiser; about 22 CPU-minutes. Writes a capture of JPEG files.
"""

import argparse
import math
import shutil
from dataclasses import replace
from pathlib import Path

from PIL import Image

from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import write_capture
from splatgraft_paper.synthesis.benchmark import rendered_cameras, sparse_points
from splatgraft_paper.synthesis.jobs import Job, RenderSize, Take, render_job
from splatgraft_paper.synthesis.places import make_scene
from splatgraft_paper.synthesis.scene import Lamp, Scene, capture_cameras

SEED = 71000
VIEWS = 28
OBJECT_HEIGHT = 0.2
"""Metres: cameras are placed for an object of this height."""


def kitchen() -> Scene:
    """The generated kitchen with a sun through its window and half the light of the overcast sky."""
    scene = make_scene("kitchen", SEED)
    place = scene.places[0].location
    window = next(lamp for lamp in scene.lamps if lamp.kind == "area")
    # towards a point left of and above the window's middle
    x, y, z = (a - b for a, b in zip(window.location, place, strict=True))
    x, z = x - 0.4, z + 0.5
    distance = math.sqrt(x * x + y * y + z * z)
    away = (-x / distance, -y / distance, -z / distance)
    sun = Lamp("sun", (1.0, 0.86, 0.68), 9.0, (0, 0, 5), away, size=0.02)
    lamps = tuple(replace(lamp, power=0.5 * lamp.power) if lamp is window else lamp for lamp in scene.lamps)
    return replace(scene, lamps=(*lamps, sun))


def main() -> None:
    """Render the capture and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--blender-python", type=Path, required=True)
    arguments = parser.parse_args()
    scene = kitchen()
    cameras = capture_cameras(scene, scene.places[0], OBJECT_HEIGHT, VIEWS, SEED)
    takes = (Take("target", scene=True, passes=("color", "depth")),)
    job = Job(scene=scene, objects={}, cameras=cameras, takes=takes, size=RenderSize(576, 400, 20))
    rendered = arguments.out / "render"
    render_job(job, rendered, arguments.blender_python)
    folder = arguments.out / "table"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    names = tuple(f"{index:04d}.jpg" for index in range(VIEWS))
    posed = rendered_cameras(rendered, names)
    points, colors = sparse_points(rendered / "target", posed, count=12_000)
    for index, name in enumerate(names):
        with Image.open(rendered / "target" / f"{index:04d}.png") as picture:
            picture.convert("RGB").save(folder / "images" / name, quality=93, subsampling=0, optimize=True)
    write_capture(folder, PosedImages(tuple(folder / "images" / name for name in names), posed, points, colors))


if __name__ == "__main__":
    main()
