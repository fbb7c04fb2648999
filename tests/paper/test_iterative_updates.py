"""Iterative updates of the benchmark: each strength of a schedule reaches a harmoniser that starts from noise."""

from dataclasses import replace
from itertools import pairwise

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats import read_gaussians, write_cameras, write_gaussians
from splatgraft.formats.gaussian_flags import write_flags
from splatgraft.harmonization import Harmonized
from splatgraft.project.step import perform
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark import methods


class Noisy:
    def __init__(self):
        self.asked = []

    def harmonize_from(self, view, strength):
        self.asked.append((strength, view))
        return Harmonized(view.composite)


def test_each_strength_of_a_schedule_reaches_the_harmoniser_with_renders_of_the_scene_so_far(tmp_path, monkeypatch):
    g = torch.Generator().manual_seed(0)
    n = 40
    scene = Gaussians(
        means=torch.rand(n, 3, generator=g) - 0.5 + torch.tensor([0.0, 0, 3]),
        log_scales=torch.full((n, 3), -2.0),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 2.0),
        sh=torch.rand(n, 1, 3, generator=g),
    )
    (tmp_path / "composite").mkdir()
    write_gaussians(tmp_path / "composite" / "scene.ply", scene)
    write_gaussians(tmp_path / "prior.ply", scene.map(lambda tensor: tensor if tensor.dim() < 3 else 0.5 * tensor))
    write_flags(tmp_path / "composite" / "is_object.npy", torch.arange(n) < 20)
    cameras = Cameras(
        world_from_camera=torch.eye(4).repeat(2, 1, 1),
        intrinsics=torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]).repeat(2, 1, 1),
        sizes=torch.tensor([[32, 32], [32, 32]]),
        names=("images/a.png", "images/b.png"),
    )
    write_cameras(tmp_path / "cameras.json", cameras)
    harmonizer, contexts = Noisy(), []
    monkeypatch.setattr(methods, "make_harmonizer", lambda options, context: contexts.append(context) or harmonizer)

    def consolidated(prior, cameras, images, options, *, progress):
        # every scene is that of before, darker
        assert len(images) == len(cameras)
        scenes.append(replace(scenes[-1], sh=0.9 * scenes[-1].sh))
        return scenes[-1]

    scenes = [read_gaussians(tmp_path / "prior.ply")]
    monkeypatch.setattr(methods, "consolidate", consolidated)
    step = methods.UpdateIteratively(
        tmp_path / "composite", tmp_path / "prior.ply", tmp_path / "cameras.json", tmp_path / "result",
        harmonizer="flux", loss="l1-dssim", schedule="geometric", device="cpu",
    )  # fmt: skip
    perform(step, Console())
    assert contexts[0].strengths == methods.STRENGTHS["geometric"]
    assert [strength for strength, _ in harmonizer.asked] == [
        one for one in methods.STRENGTHS["geometric"] for _ in range(2)
    ]
    # each update starts from a render of the scene so far; the composite is the condition of all
    for before, after in pairwise(view for _, view in harmonizer.asked[::2]):
        assert 0 < float(after.prior.mean()) < float(before.prior.mean()) < float(after.composite.mean())
        assert torch.equal(before.composite, after.composite)
    assert (tmp_path / "result" / "scene.ply").is_file()
