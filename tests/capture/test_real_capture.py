"""Capture, structure from motion: sixteen photographs of bananas on a carpet, with plain pycolmap as it is called.

Their shipped poses come from a run with many more features, at twice the size. Incremental mapping of these smaller
photos finds four models, the largest with 8 photos; the global mapper joins them.
"""

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from splatgraft.capture import PoseOptions, pose_photos
from splatgraft.formats import read_capture
from splatgraft.formats.captures.masks import find_photos

BANANAS = Path(__file__).parents[2] / "src" / "splatgraft" / "demo_captures" / "bananas"


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")
def test_bananas_on_a_carpet_are_one_model_with_the_known_poses(tmp_path: Path) -> None:
    posed, report = pose_photos(find_photos(BANANAS / "images"), tmp_path, options=PoseOptions(effort="quick"))
    # two photos have hardly a feature on the carpet that both SIFT runs find
    assert report.registered >= 13
    known = read_capture(BANANAS)
    index = {Path(name).stem: i for i, name in enumerate(known.cameras.names)}
    truth = known.cameras.world_from_camera[[index[Path(name).stem] for name in posed.cameras.names]].double()
    found = posed.cameras.world_from_camera.double()
    focal = float(known.cameras.intrinsics[0, 0, 0])
    assert report.lenses[0].focal_px == pytest.approx(focal, rel=0.01)  # two runs of the same photos
    # the two worlds differ by a turn: the mean of the turns between them, by SVD; what is left is the error
    turns = truth[:, :3, :3] @ found[:, :3, :3].transpose(1, 2)
    u, _, vt = torch.linalg.svd(turns.sum(0))
    left = (u @ vt).T @ turns
    trace = left.diagonal(dim1=1, dim2=2).sum(1)
    # half a pixel at a focal length of 1110 px is 0.03 degrees; a wrong model is off by tens of degrees
    assert float(torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1))).max()) < 1
