"""`paper consolidate`: the paper's descent, and updates of the views from renders of the scene so far."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from killing import Killed
from random_lpips import write_random_lpips
from tiny_models import CHANNELS, flux_folder, quiet

from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_gaussians
from splatgraft.harmonization import FluxOptions, NoneOptions
from splatgraft.harmonization.flux.harmonizer import FluxHarmonizer
from splatgraft.project.step import perform
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.steps.harmonize import Harmonize
from splatgraft_paper.commands.consolidate import Consolidate
from splatgraft_paper.consolidation import descend_as_paper

pytestmark = list(quiet)


def consolidation(project, harmonized, out, **other):
    scene = project / "relit" / "scene.ply"
    return Consolidate(scene, project / "views", harmonized, out, device="cpu", **other)


def test_every_update_begins_at_the_noise_of_the_schedule_on_renders_of_the_scene_so_far(
    finished_project, tmp_path, monkeypatch
):
    weights = flux_folder(tmp_path / "image-mask", 12 * CHANNELS)
    harmonized = tmp_path / "harmonized"
    perform(
        Harmonize(finished_project / "views", harmonized, FluxOptions(weights=str(weights)), device="cpu"), Console()
    )
    asked, original = [], FluxHarmonizer.harmonize_from

    def watched(self, view, strength):
        asked.append((strength, view))
        return original(self, view, strength)

    monkeypatch.setattr(FluxHarmonizer, "harmonize_from", watched)
    descents = []

    def descend(composite, cameras, images, settings, **services):
        made = descend_as_paper(composite, cameras, images, settings, **services)
        descents.append((composite.sh, made.sh, settings))
        return made

    monkeypatch.setattr("splatgraft_paper.commands.consolidate.descend_as_paper", descend)
    options = {"loss": "l1-dssim", "iterations": 20}
    once = perform(consolidation(finished_project, harmonized, tmp_path / "once", **options), Console())
    step = consolidation(
        finished_project, harmonized, tmp_path / "thrice", updates=3, schedule="geometric", **options
    )  # fmt: skip
    thrice = perform(step, Console())
    views = ViewFolder.open(finished_project / "views")
    count = len(views)
    assert [strength for strength, _ in asked] == pytest.approx([0.1**0.5] * count + [0.1] * count)
    first, second = asked[0][1], asked[count][1]
    # the composite is the condition of all updates; the first one starts from the scene of a single consolidation
    assert torch.equal(first.composite, views.read(0).composite)
    assert torch.equal(first.composite, second.composite)
    begun = render(read_gaussians(once / "scene.ply"), views.cameras[0]).color[0].clamp(0, 1)
    assert torch.allclose(first.prior, begun, atol=1e-4)
    assert not torch.allclose(second.prior, first.prior, atol=1e-3)
    # each update goes on from the last state, with a fifth of the steps
    assert [(settings.continued, settings.iterations) for *_, settings in descents[1:]] == [(False, 20)] + [
        (True, 4)
    ] * 2
    assert torch.equal(descents[2][0], descents[1][1])
    assert torch.equal(descents[3][0], descents[2][1])
    assert torch.equal(read_gaussians(thrice / "scene.ply").sh, descents[3][1])
    # the figure of 1, 2 and 3 updates
    for number in range(3):
        assert torch.equal(read_gaussians(thrice / "updates" / str(number) / "scene.ply").sh, descents[number + 1][1])
    # killed at the second view of the last update, it continues with that view
    made = len(asked)

    def killed(self, view, strength):
        if len(asked) == made + count + 1:
            raise Killed
        return watched(self, view, strength)

    monkeypatch.setattr(FluxHarmonizer, "harmonize_from", killed)
    again = replace(step, out=tmp_path / "again")
    with pytest.raises(Killed):
        perform(again, Console())
    monkeypatch.setattr(FluxHarmonizer, "harmonize_from", watched)
    perform(again, Console())
    assert len(asked) == made + 2 * count
    assert len(descents) == 1 + 3 + 3
    assert torch.equal(read_gaussians(again.out / "scene.ply").sh, descents[3][1])


def test_a_method_without_noise_begins_at_renders_too_and_says_so(finished_project, tmp_path, capsys):
    harmonized = tmp_path / "harmonized"
    perform(Harmonize(finished_project / "views", harmonized, NoneOptions(), device="cpu"), Console())
    perform(
        consolidation(finished_project, harmonized, tmp_path / "out", method="fast", updates=2, passes=1), Console()
    )
    assert "none: no noise; each of 2 updates begins at renders of the scene so far" in capsys.readouterr().err


def test_views_of_an_unknown_method_cannot_be_updated(finished_project, tmp_path):
    step = consolidation(finished_project, finished_project / "views", tmp_path / "out", updates=2)
    with pytest.raises(ValueError, match=r"step.json: expected a method of .*flux.* for updates, found None"):
        step.harmonizer_options()
    with pytest.raises(ValueError, match="expected updates of at least 1, found 0"):
        perform(replace(step, images=finished_project / "harmonized", updates=0), Console())


def test_the_default_minimises_lpips_alone(finished_project, tmp_path):
    write_random_lpips(tmp_path)
    step = consolidation(finished_project, tmp_path, tmp_path / "out", lpips_weights=tmp_path)
    generator = torch.Generator().manual_seed(0)
    pair = [torch.rand(32, 32, 3, generator=generator) for _ in range(2)]
    loss = step.image_loss()
    assert torch.equal(loss(*pair), lpips_vgg(tmp_path)(*pair))
    # section 6: 10,000 steps
    assert step.iterations == 10_000
