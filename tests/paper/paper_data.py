"""A folder in the layout of `paper tables`, with pictures of the shipped benchmark scene."""

import shutil
from pathlib import Path

from splatgraft.core.images import read_mask, read_rgb, write_image

TERRACE = Path(__file__).parents[2] / "data" / "benchmark" / "terrace"
STEMS = tuple(f"{index:04d}" for index in range(17))
"""Number of views; 3 of them are held out."""
PLAIN = "bathtub_57e_in_blend_57eadb"
OTHER = "sink_in_blend_92e6c7"
REAL = "truck_in_garden"


def parts_of_view(stem):
    """Return truth, background, mask and a pasted composite of one view."""
    truth = read_rgb(TERRACE / "ground_truth" / "images" / f"{stem}.png")
    background = read_rgb(TERRACE / "target" / "images" / f"{stem}.png")
    mask = read_mask(TERRACE / "ground_truth" / "masks" / f"{stem}.png")
    composite = mask[..., None] * (1.4 * truth).clamp(0, 1) + (1 - mask[..., None]) * background
    return truth, background, mask, composite


def write_data(root):
    """Write scenes of all three kinds, with the authors' pictures."""
    synthetic, results = root / "data_3d/synthetic/insertions", root / "results_3d"
    rotation = root / "data_rotation/bathroom"
    for stem in STEMS:
        truth, background, _, composite = parts_of_view(stem)
        half = 0.5 * (truth + composite)
        for scene in (PLAIN, OTHER):
            for name, image in (("gt", truth), ("background", background), ("composite", composite)):
                put(synthetic / scene / name / f"{stem}.png", image)
            put(results / "synthetic" / "ours" / scene / f"{stem}.png", half)
            put(results / "synthetic" / "gs_ir" / scene / f"{stem}.png", composite)
        put(root / "data_3d/real/insertions" / REAL / "composite" / f"{stem}.png", composite)
        put(results / "real" / "ours" / REAL / f"{stem}.png", half)
        for pose in ("rot_000", "rot_120", "rot_240"):
            put(rotation / pose / "gt" / f"{stem}.png", truth)
            put(rotation / pose / "composite" / f"{stem}.png", composite)
    for number, stem in enumerate(STEMS[::8]):
        for pose in ("rot_000", "rot_120", "rot_240"):
            put(root / "results_rotation/ours/bathroom" / pose / f"{number:05d}.png", parts_of_view(stem)[0] * 0.9)
    shutil.copytree(TERRACE / "target", root / "data_3d/synthetic/scenes/backgrounds/blend_57eadb")
    shutil.copytree(TERRACE / "source", root / "data_3d/synthetic/scenes/objects/bathtub_57e")
    return root


def put(path, image):
    """Write a picture into a folder, which is made if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, image)
