"""Numbers and choices of the paper that no recipe holds: names of methods, threshold, ORIDa's amounts."""

import pytest

from splatgraft.fitting import l1_dssim
from splatgraft.fitting.perceptual_losses import windowed_fourier
from splatgraft.runtime.console import Console
from splatgraft.segmentation import SelectOptions
from splatgraft.steps.segment import Segment
from splatgraft_paper.benchmark import methods
from splatgraft_paper.benchmark.methods import Method, MethodSettings, run_method
from splatgraft_paper.benchmark.scene import ComposedScene
from splatgraft_paper.commands.generated import GeneratedPairs, OridaPairs


@pytest.mark.parametrize(
    ("name", "method", "loss", "updates"),
    [
        ("off+flux/paper", "paper", "lpips", (1, None)),
        ("off+flux/paper-l1-dssim", "paper", l1_dssim, (1, None)),
        ("off+flux/paper@linear", "paper", "lpips", (5, "linear")),
        ("off+flux/paper@geometric", "paper", "lpips", (5, "geometric")),
        ("paper", "paper", "lpips", (1, None)),
        ("paper/paper-l1-dssim", "paper", l1_dssim, (1, None)),
        ("paper@geometric", "paper", "lpips", (5, "geometric")),
        ("off+flux/lpips", "fast", "lpips", (1, None)),
        ("off+flux/l1-dssim", "fast", l1_dssim, (1, None)),
        ("off+flux", "fast", windowed_fourier, (1, None)),
    ],
)
def test_a_method_s_name_selects_its_consolidation(tmp_path, monkeypatch, name, method, loss, updates):
    steps = []
    monkeypatch.setattr(methods, "perform_if_stale", lambda step, console: steps.append(step) or 1.0)
    monkeypatch.setattr("splatgraft_paper.commands.consolidate.lpips_vgg", lambda folder: "lpips")
    scene = ComposedScene("a_scene", tmp_path)
    run_method(Method.parse(name), scene, MethodSettings(model="weights"), Console())
    render, harmonize, step = steps
    assert render.prior == scene.composite / "scene.ply"
    assert harmonize.method.name == "flux"
    assert step.harmonizer == harmonize.method
    assert step.method == method
    assert step.image_loss() == loss
    assert (step.updates, step.schedule if step.updates > 1 else None) == updates
    # section 6: 10,000 iterations
    assert step.iterations == 10_000


def test_the_step_selects_gaussians_at_the_paper_s_threshold(tmp_path):
    # section 4: a similarity threshold of 0.75
    assert Segment(tmp_path, tmp_path, tmp_path).threshold == SelectOptions().threshold == 0.75


def test_relit_sources_have_the_paper_s_amounts(tmp_path):
    # section 5.2: 2K targets and 8K composites of ORIDa, 1.6K and 6.5K of FLUX
    orida, generated = OridaPairs(tmp_path, tmp_path), GeneratedPairs(tmp_path, tmp_path)
    assert (orida.number, orida.number * orida.relighting.each) == (2000, 8000)
    assert (generated.number, generated.number * generated.relighting.each) == (1600, 6400)
