"""benchmarks/captures.py on a generated capture: one reconstruction gives a line for each size of picture."""

import os
import subprocess
import sys
from pathlib import Path

import captures
import pytest
import torch
from object_captures import object_capture

from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import write_capture


@pytest.fixture
def folder(tmp_path) -> Path:
    made = object_capture("plain", views=9, size=(96, 72))
    paths = tuple(tmp_path / f"{i}.png" for i in range(len(made.images)))
    for path, image in zip(paths, made.images, strict=True):
        write_image(path, image)
    (tmp_path / "masks").mkdir()
    for i, mask in enumerate(made.masks):
        write_image(tmp_path / "masks" / f"{i}.png", mask.float())
    points = made.scene.means[::4]
    photos = PosedImages(
        image_paths=paths, cameras=made.cameras, points=points, point_colors=torch.full((len(points), 3), 0.5)
    )
    (tmp_path / "bench" / "toy").mkdir(parents=True)
    write_capture(tmp_path / "bench" / "toy", photos)
    return tmp_path / "bench"


@pytest.mark.long
def test_one_reconstruction_is_compared_at_every_size_that_is_asked_for(folder):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    words = [
        str(folder),
        "--quality",
        "draft",
        "--longest-px",
        "48",
        "96",
        "--object",
        "--masks",
        str(folder.parent / "masks"),
    ]
    done = subprocess.run(
        [sys.executable, captures.__file__, *words], capture_output=True, text=True, check=True, env=environment
    )
    small, large, cut, fitted = (
        dict(word.split("=") for word in line.split() if "=" in word) for line in done.stdout.splitlines()
    )
    assert (small["longest_px"], large["longest_px"]) == ("48", "96")
    assert (small["capture"], small["quality"], small["views"]) == ("toy", "draft", "2")
    # one reconstruction, so its cost is equal to the second
    assert all(small[name] == large[name] for name in ("seconds", "cpu_seconds", "gaussians", "peak_mb"))
    # each size is compared by itself; one figure alone may be equal after rounding
    figures = ("psnr", "psnr_fit", "ssim", "flip")
    assert [small[name] for name in figures] != [large[name] for name in figures]
    assert float(large["psnr"]) > 20
    # after the fit of its own, the object exceeds its outline less
    assert float(fitted["overlap"]) > float(cut["overlap"])
    assert float(fitted["psnr_fit"]) > 25
