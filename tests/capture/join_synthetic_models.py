"""A program: two parts of a synthetic model, of which one is moved, turned and scaled, are joined and refined.

Arguments: the folder of colmap_process, and a folder to write into. pycolmap must not share a process with Pillow.
"""

import sys
from pathlib import Path

import numpy as np
import pycolmap

sys.path.insert(0, sys.argv[1])
from colmap_process.job import Job
from colmap_process.joining import joined
from colmap_process.refinement import refined

folder = Path(sys.argv[2])
pycolmap.set_random_seed(0)
options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points3D=300)
with pycolmap.Database.open(folder / "photos.db") as opened:
    truth = pycolmap.synthesize_dataset(options, opened)
pycolmap.synthesize_images(pycolmap.SyntheticImageOptions(), truth, folder)
photos = sorted(truth.reg_image_ids())
names = [truth.images[i].name for i in photos]


def part(kept):
    model = pycolmap.Reconstruction(truth)
    for i in set(photos) - set(kept):
        model.deregister_frame(model.images[i].frame_id)
    return model


def error(model):
    centers = [(model.images[i].projection_center(), truth.images[i].projection_center()) for i in photos]
    return max(float(np.linalg.norm(a - b)) for a, b in centers)


large, small = part(photos[:7]), part(photos[4:])
small.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2, 3])))
whole = joined([small, large])
assert whole.num_reg_images() == 10
assert error(whole) < 1e-9, error(whole)  # float64 rounding
assert joined([part(photos[:4]), part(photos[6:])]) is None  # no photo is shared
job = Job(str(folder), "", str(folder), False, [names], True, 1, 0)
assert refined(job, folder / "photos.db", [small, large]).num_reg_images() == 10
# photos that no model holds are posed from the points of the others
assert refined(job, folder / "photos.db", [part(photos[:7])]).num_reg_images() == 10
