"""The paper's consolidation: closer to the images, geometry unchanged, and resumed after a kill."""

from dataclasses import fields

import pytest
import torch
from memory_checkpoint import KilledError, MemoryCheckpoint

from splatgraft.core.image_metrics import psnr
from splatgraft.fitting.perceptual_losses import l1
from splatgraft.rendering import render
from splatgraft_paper.consolidation import PaperDescent, descend_as_paper

PAPER = PaperDescent(loss=l1, iterations=24)


def test_comes_closer_to_the_images_and_keeps_the_geometry(relit):
    out = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER)
    for field in fields(out):
        if field.name != "sh":
            assert torch.equal(getattr(out, field.name), getattr(relit.composite, field.name))
    before, after = (render(scene, relit.cameras).color for scene in (relit.composite, out))
    truth = torch.stack(relit.images)
    assert float(psnr(after, truth)) > float(psnr(before, truth))


def test_a_killed_descent_resumes_to_the_same_bits(relit, monkeypatch):
    monkeypatch.setattr("splatgraft.consolidation.color_fit._SAVE_EVERY", 8)
    whole = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER)
    memory = MemoryCheckpoint()

    def die(done, total, message):
        if done == 19:
            raise KilledError

    with pytest.raises(KilledError):
        descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER, progress=die, checkpoint=memory)
    assert memory.state is not None
    assert memory.state["iteration"] == 16
    resumed = descend_as_paper(relit.composite, relit.cameras, relit.images, PAPER, checkpoint=memory)
    assert torch.equal(resumed.sh, whole.sh)
