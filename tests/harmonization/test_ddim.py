"""DDIM and the schedule of Stable Diffusion: compared with diffusers, and exact for the true prediction."""

import pytest
import torch

from splatgraft.harmonization.flux.ddim import NoiseSchedule, ddim


def test_the_schedule_is_that_of_diffusers():
    diffusers = pytest.importorskip("diffusers")
    reference = diffusers.DDPMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", prediction_type="v_prediction"
    )
    ours = NoiseSchedule.stable_diffusion()
    # theirs is summed in float32: 1000 factors of relative error 6e-8
    assert torch.allclose(ours.alpha_bar, reference.alphas_cumprod, rtol=1e-4)
    clean, noise = torch.randn(2, 3, 4, 4), torch.randn(2, 3, 4, 4)
    step = torch.tensor([10, 900])
    assert torch.allclose(ours.noisy(clean, noise, step), reference.add_noise(clean, noise, step), atol=1e-4)
    assert torch.allclose(ours.velocity(clean, noise, step), reference.get_velocity(clean, noise, step), atol=1e-4)


@pytest.mark.parametrize("predicts", ["noise", "velocity"])
def test_the_true_answer_leads_to_the_clean_picture(predicts):
    schedule = NoiseSchedule.stable_diffusion()
    g = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(1, 3, 4, 4, generator=g), torch.randn(1, 3, 4, 4, generator=g)

    def truth(latents, step):
        return noise if predicts == "noise" else schedule.velocity(clean, noise, torch.tensor([step]))

    start = schedule.noisy(clean, noise, torch.tensor([999]))
    made = ddim(truth, start, schedule, steps=10, predicts=predicts)
    # the first step divides float32 rounding by sqrt(alpha-bar) = 0.068
    assert torch.allclose(made, clean, atol=1e-4)
