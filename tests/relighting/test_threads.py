"""Kernels started from several threads at once, on the threading layer that ends the process where they overlap."""

import os
import subprocess
import sys

PROGRAM = """
import threading
import torch
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.relighting.normals import estimate_normals
from splatgraft.relighting.shadows.shadow_maps import Window, occluders_of, splat_depth_maps, visibility
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

n = 3000
points = even_directions(n)
quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
ball = Gaussians(points, torch.full((n, 3), -3.0), quaternions, torch.zeros(n), torch.zeros(n, 1, 3))
eyes = torch.tensor([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0]])
cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 60.0, width=64, height=48)
window = Window(torch.zeros(3), 1.5, frames_along(even_directions(8)))

def maps():
    found = splat_depth_maps(occluders_of(ball), window, size=64, with_color=False)
    visibility(found, points, points, bias=0.1)

def again(work):
    for _ in range(30):
        work()

maps(), estimate_normals(ball, cameras), render(ball, cameras)
works = (maps, lambda: estimate_normals(ball, cameras), lambda: render(ball, cameras))
threads = [threading.Thread(target=again, args=(work,)) for work in works]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print("all ended")
"""


def test_threads_may_light_and_render_at_once_without_openmp():
    environment = {**os.environ, "NUMBA_THREADING_LAYER": "workqueue"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.strip() == "all ended"
