"""Each equation of the paper's training, compared with numpy in float64, written from the paper alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("diffusers")

from tiny_models import quiet
from tiny_pairs import relit_folder, rendered_folder
from tiny_training import QUICK, silent, training

from splatgraft_paper.training.loop import train
from splatgraft_paper.training.objective import ObjectiveTask
from splatgraft_paper.training.pairs import open_relit, open_rendered

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]


def soft_edged(folder, kind):
    """Return a folder of one pair whose object has soft edges; the relit object is RGBA with straight alpha."""
    rng, side = np.random.default_rng(0), 32
    y, x = np.mgrid[:side, :side]
    mask = np.clip((11 - np.hypot(x - 15.5, y - 15.5)) / 4, 0, 1)  # covers edges of four pixels
    files = {
        "target": rng.integers(40, 220, (side, side, 3)),
        "background": rng.integers(0, 256, (side, side, 3)),
        "mask": np.repeat(np.rint(mask * 255)[..., None], 3, 2),
        "relit": np.concatenate([rng.integers(60, 200, (side, side, 3)), np.rint(mask * 255)[..., None]], 2),
    }
    files = {name: np.asarray(picture, np.uint8) for name, picture in files.items()}
    if kind == "rendered":
        scene = rendered_folder(folder, 1)
        (place,) = (path.parent.parent for path in scene.glob("*/background/0000.png"))
        take = place / "object0"
        names = {"target": take / "0000.png", "mask": take / "0000_mask.png"}
        names |= {"background": place / "background" / "0000.png", "relit": place / "object0_light0" / "0000.png"}
    else:
        relit_folder(folder, 1)
        (place,) = (path.parent for path in folder.glob("*/target.png"))
        names = {name: place / f"{name}.png" for name in ("target", "background", "mask")}
        names["relit"] = place / "relit_0.png"
    for name, path in names.items():
        Image.fromarray(files[name]).save(path)
    return {name: picture / 255 for name, picture in files.items()}


@pytest.mark.parametrize("kind", ["rendered", "relit"])
def test_a_composite_is_equation_2_at_every_pixel(tmp_path, kind):
    files = soft_edged(tmp_path / "pairs", kind)
    m = files["mask"][..., :1]
    assert ((m > 0) & (m < 1)).sum() > 100
    straight = files["relit"][..., :3]

    def moments(image):
        mean = (m * image).sum((0, 1)) / m.sum()
        return mean, np.sqrt((m * (image - mean) ** 2).sum((0, 1)) / m.sum())

    (mean, deviation), (wanted_mean, wanted_deviation) = moments(straight), moments(files["target"])
    normalised = np.clip((straight - mean) / deviation * wanted_deviation + wanted_mean, 0, 1)
    expected = m * normalised + (1 - m) * files["background"]
    pair = (open_rendered if kind == "rendered" else open_relit)(tmp_path / "pairs").pairs[0].read()
    # float32 sums over 1024 pixels
    assert np.abs(pair.composite.numpy() - expected).max() < 1e-5


class Recorder:
    """Stand-in for a network: keeps its input and answers with known numbers."""

    config = SimpleNamespace(guidance_embeds=False)

    def __init__(self, answer):
        self.answer, self.given = answer, []

    def __call__(self, *arguments, **named):
        named.pop("return_dict")
        self.given.append([*arguments, named])
        return (self.answer,)


def unpacked(tokens, height, width):
    """Return FLUX's tokens as latents in numpy: token (i, j) holds 2 x 2 pixels, channel by channel."""
    b, _, d = tokens.shape
    latents = np.zeros((b, d // 4, height, width))
    for i in range(height):
        for j in range(width):
            token = tokens[:, (i // 2) * (width // 2) + j // 2]
            latents[:, :, i, j] = token[:, [4 * c + 2 * (i % 2) + j % 2 for c in range(d // 4)]]
    return latents


def flux_loss(tmp_path, times, samples, **options):
    """Return the loss of random latents, with all inputs of the network, in numpy."""
    run = training(tmp_path, "out", QUICK, times=times, **options)
    generator = torch.Generator().manual_seed(5)
    roles, size = run.task.objective.roles, (samples, 4, 4, 4)
    latents = {role: torch.randn(size, generator=generator) for role in roles}
    network = Recorder(torch.randn(samples, 4, 16, generator=generator))
    loss = float(run.task.objective.loss(network, latents, range(100, 100 + samples)))
    ((given,),) = network.given
    joined = unpacked(given["hidden_states"].double().numpy(), 4, 4)
    answer = unpacked(network.answer.double().numpy(), 4, 4)
    t = given["timestep"].double().numpy()[:, None, None, None]
    return run, loss, given, joined, answer, t, {role: z.double().numpy() for role, z in latents.items()}


@pytest.mark.parametrize("times", ["uniform", "schnell"])
def test_the_loss_is_equation_1_and_every_noise_level_weighs_the_same(tmp_path, times):
    _, loss, _, joined, v, t, z = flux_loss(tmp_path, times, 64)
    z_t = joined[:, :4]
    eps = (z_t - (1 - t) * z["target"]) / t  # z_t = (1 - t) z_0 + t eps
    # 4096 draws: mean and variance of a normal have deviations of 1 / 64 and 1.41 / 64; four of them
    assert abs(eps.mean()) < 4 / 64
    assert abs(eps.var() - 1) < 4 * 1.41 / 64
    assert abs(np.corrcoef(eps.reshape(64, -1).mean(1), t.ravel())[0, 1]) < 4 / 8
    expected = ((v - (eps - z["target"])) ** 2).mean()  # one weight for all samples and levels
    # float32, and eps is won back by a division by t
    assert abs(loss - expected) < 1e-4 * expected


@pytest.mark.parametrize(("condition", "second"), [("image-mask", "mask"), ("image-background", "background")])
def test_conditions_are_joined_along_channels_without_noise(tmp_path, condition, second):
    _, _, _, joined, _, _, z = flux_loss(tmp_path, "uniform", 3, condition=condition)
    assert np.array_equal(joined[:, 4:8], z["composite"])
    assert np.array_equal(joined[:, 8:], z[second])


def test_the_text_is_the_empty_prompt_for_every_sample(tmp_path):
    from safetensors.numpy import load_file

    _, _, given, *_ = flux_loss(tmp_path, "uniform", 3)
    prompt = load_file(tmp_path / "base" / "empty_prompt.safetensors")
    assert np.array_equal(given["encoder_hidden_states"], np.repeat(prompt["tokens"][None], 3, 0))
    assert np.array_equal(given["pooled_projections"], np.repeat(prompt["pooled"][None], 3, 0))
    assert not given["txt_ids"].any()
    assert set(given) == {
        *("hidden_states", "timestep", "encoder_hidden_states", "pooled_projections", "txt_ids", "img_ids")
    }


def test_times_are_distributed_as_their_option_says(tmp_path):
    from scipy.stats import kstest

    def drawn(times):
        return flux_loss(tmp_path, times, 2000)[5].ravel()

    uniform = drawn("uniform")
    assert uniform.min() > 0
    # seeds are fixed, so these are the probabilities of such a deviation, not of a random failure
    assert kstest(uniform, "uniform").pvalue > 0.01
    levels, counts = np.unique(drawn("schnell"), return_counts=True)
    assert np.array_equal(levels, [0.25, 0.5, 0.75, 1.0])
    # a quarter of 2000 has a deviation of 19
    assert np.abs(counts - 500).max() < 4 * 19.4


@pytest.mark.parametrize("first_layer", ["repeat", "zero"])
def test_the_first_layer_is_repeated_as_the_paper_says_or_starts_blind_to_conditions(tmp_path, first_layer):
    from safetensors.numpy import load_file

    run = training(tmp_path, "out", QUICK, first_layer=first_layer)
    base = load_file(tmp_path / "base" / "transformer" / "diffusion_pytorch_model.safetensors")
    weight, bias = (base[f"x_embedder.{name}"].astype(np.float64) for name in ("weight", "bias"))
    tokens = np.random.default_rng(1).standard_normal((5, 3, weight.shape[1]))
    joined = torch.from_numpy(tokens.reshape(5, -1)).float()
    found = run.task.objective.network.x_embedder(joined).detach().numpy()
    heard = tokens.sum(1) if first_layer == "repeat" else tokens[:, 0]
    # float32 products of 48 numbers
    assert np.abs(found - (heard @ weight.T + bias)).max() < 1e-5
    others = {name: value for name, value in base.items() if not name.startswith("x_embedder.")}
    now = run.task.objective.network.state_dict()
    assert all(np.array_equal(value, now[name].numpy()) for name, value in others.items())


class Squares(ObjectiveTask):
    """Linear layer with squares that the training minimises."""

    def __init__(self, options):
        self.network, self.fingerprint, self._options = torch.nn.Linear(6, 3), {}, options

    def read(self, position):
        return torch.randn(5, 6, generator=torch.Generator().manual_seed(position)) * 30

    def loss(self, network, items):
        return (network(torch.cat(items)) ** 2).sum()

    def validate(self, network):
        return None


def test_a_step_is_adam_of_the_clipped_gradient(tmp_path):
    loop = replace(QUICK, steps=3, batch=1, rate=3e-5, clip=1.0)
    task = Squares(loop)
    w, b = (p.detach().double().numpy().copy() for p in task.network.parameters())
    moments = [[np.zeros_like(p), np.zeros_like(p)] for p in (w, b)]
    for step in range(1, 4):
        x = task.read(step - 1).double().numpy()
        out = 2 * (x @ w.T + b)
        grads = [out.T @ x, out.sum(0)]
        norm = np.sqrt(sum((g**2).sum() for g in grads))
        assert norm > 1
        for p, g, m in zip((w, b), grads, moments, strict=True):
            # Kingma and Ba 2015, Algorithm 1, with its published constants; no weight decay
            m[0] = 0.9 * m[0] + 0.1 * g / norm
            m[1] = 0.999 * m[1] + 0.001 * (g / norm) ** 2
            p[:] = p - 3e-5 * (m[0] / (1 - 0.9**step)) / (np.sqrt(m[1] / (1 - 0.999**step)) + 1e-8)
    state = train(task, loop, tmp_path, say=silent, progress=silent)
    # a step is 3e-5 per weight; weights below 1 are rounded at 6e-8
    assert np.abs(state["weight"].numpy() - w).max() < 3e-7
    assert np.abs(state["bias"].numpy() - b).max() < 3e-7


def test_object_removal_learns_the_velocity_of_stable_diffusion_2(tmp_path):
    from tiny_models import removal_folder

    from splatgraft_paper.training.removal import RemovalObjective

    objective = RemovalObjective(str(removal_folder(tmp_path / "base")), lambda words: None)
    generator = torch.Generator().manual_seed(5)
    latents = {role: torch.randn(32, 4, 4, 4, generator=generator) for role in objective.roles}
    network = Recorder(torch.randn(32, 4, 4, 4, generator=generator))
    loss = float(objective.loss(network, latents, range(32)))
    ((joined, step, _, _),) = network.given
    betas = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
    signal = np.cumprod(1 - betas)[step.numpy()][:, None, None, None]
    clean, joined = latents["background"].double().numpy(), joined.double().numpy()
    eps = (joined[:, :4] - np.sqrt(signal) * clean) / np.sqrt(1 - signal)
    # 2048 draws: deviations of 1 / 45 and 1.41 / 45; four of them
    assert abs(eps.mean()) < 4 / 45
    assert abs(eps.var() - 1) < 4 * 1.41 / 45
    # Salimans and Ho 2022: v = alpha eps - sigma x
    expected = ((network.answer.numpy() - (np.sqrt(signal) * eps - np.sqrt(1 - signal) * clean)) ** 2).mean()
    # float32, and eps is won back by a division by at least 0.03
    assert abs(loss - expected) < 1e-4 * expected
    assert np.array_equal(joined[:, 4:8], latents["target"].numpy())
    assert np.array_equal(joined[:, 8:], latents["mask"].numpy())
    assert len(np.unique(step)) > 20
