"""Time and memory of the harmoniser `flux` against stock diffusers on one card, per view and per part.

`python benchmarks/harmonize.py` on a machine with a GPU and `pip install 'splatgraft[flux,text]'`; random weights of
the real size (nothing is downloaded), 704x496. `--tiny` runs the same code with a few thousand parameters on the CPU;
its times are not those of the real model.

stock    both text encoders for each view's prompt, the transformer as it is, one view at a time
ours     no text encoder, modulations from a table, --batch views at once
compiled ours after torch.compile
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

from splatgraft.harmonization import FluxOptions, HarmonizerInputs
from splatgraft.harmonization.flux.baked_modulation import bake
from splatgraft.harmonization.flux.harmonizer import FluxHarmonizer
from splatgraft.harmonization.flux.loading import diffusers_library
from splatgraft.harmonization.flux.network import Autoencoder, FluxNetwork, pad_by_reflection, velocity
from splatgraft.harmonization.flux.prompt import PromptEmbedding
from splatgraft.harmonization.flux.sampling import noise, sample, schnell_levels

REAL = {"in_channels": 192, "out_channels": 64}
TINY = {
    "in_channels": 192, "out_channels": 64, "num_layers": 1, "num_single_layers": 2, "attention_head_dim": 16,
    "num_attention_heads": 2, "joint_attention_dim": 4096, "pooled_projection_dim": 768, "axes_dims_rope": (4, 6, 6),
}  # fmt: skip
# FLUX.1's vae/config.json
AUTOENCODER = {
    "block_out_channels": (128, 256, 512, 512), "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4, "latent_channels": 16, "layers_per_block": 2,
    "scaling_factor": 0.3611, "shift_factor": 0.1159, "use_quant_conv": False, "use_post_quant_conv": False,
}  # fmt: skip
TINY_AUTOENCODER = {**AUTOENCODER, "block_out_channels": (8, 8, 8, 8), "layers_per_block": 1, "norm_num_groups": 4}
TOKENS = 256


def random_network(kind: Any, settings: dict[str, Any], device: torch.device, dtype: torch.dtype) -> Any:
    """Make a network with random weights directly on the device, so that 24 GB need not pass through the CPU."""
    torch.manual_seed(0)
    with torch.device(device):
        default = torch.get_default_dtype()
        torch.set_default_dtype(dtype)
        try:
            return kind(**settings).eval().requires_grad_(False)
        finally:
            torch.set_default_dtype(default)


def text_encoders(device: torch.device, tiny: bool) -> Callable[[], None] | None:
    """Make a function that runs T5 (XXL) and CLIP (L) once; None where transformers is not installed."""
    try:
        import transformers
    except ModuleNotFoundError:
        return None
    small = {"num_layers": 1, "d_ff": 16, "num_heads": 2, "d_kv": 8} if tiny else {}
    real = {"num_layers": 24, "d_ff": 10240, "num_heads": 64, "d_kv": 64}
    t5 = transformers.T5Config(
        d_model=64 if tiny else 4096, vocab_size=32128, feed_forward_proj="gated-gelu", **(small or real)
    )
    clip = transformers.CLIPTextConfig(
        hidden_size=768, intermediate_size=3072, num_hidden_layers=1 if tiny else 12, num_attention_heads=12
    )
    dtype = torch.float32 if tiny else torch.bfloat16
    encoder = random_network(transformers.T5EncoderModel, {"config": t5}, device, dtype)
    pooled = random_network(transformers.CLIPTextModel, {"config": clip}, device, dtype)
    long, short = (torch.ones(1, n, dtype=torch.long, device=device) for n in (TOKENS, 77))

    @torch.no_grad()
    def encode() -> None:
        encoder(long)
        pooled(short)

    return encode


def seconds(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Median time of `work` after two warm-up runs."""
    times = []
    for i in range(repeats + 2):
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if i >= 2:
            times.append(time.perf_counter() - begin)
    return statistics.median(times)


def parts(network: FluxNetwork, batch: int, size: tuple[int, int], repeats: int) -> dict[str, float]:
    """Seconds per view of encoding, the four sampling steps, decoding, and the whole harmonisation."""
    (width, height), device = size, network.device
    pictures = torch.rand(2 * batch, 3, height, width)
    padded = pad_by_reflection(pictures).to(device)
    h, w = padded.shape[2] // 8, padded.shape[3] // 8
    conditions = torch.randn(batch, 32, h, w, device=device)
    start = noise((16, h, w), 0).to(device).expand(batch, -1, -1, -1)

    def step(latents: torch.Tensor, level: float) -> torch.Tensor:
        joined = torch.cat([latents, conditions], 1).to(network.dtype)
        return velocity(network.transformer, joined, torch.full((batch,), level, device=device), network.prompt)

    flat = torch.zeros(height, width)
    image = pictures[0].permute(1, 2, 0).contiguous()
    view = HarmonizerInputs(image, image, flat, flat, torch.zeros(height, width, 3), image)
    harmonizer = FluxHarmonizer(network, FluxOptions(batch=batch))
    work: dict[str, Callable[[], object]] = {
        "encode": lambda: network.autoencoder.encode(padded),
        "steps": lambda: sample(step, start, schnell_levels()),
        "decode": lambda: network.autoencoder.decode(start),
        "whole": lambda: harmonizer.harmonize_all([view] * batch),
    }
    return {name: seconds(run, device, repeats) / batch for name, run in work.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", default="704x496")
    parser.add_argument("--no-compile", action="store_true")
    options = parser.parse_args()
    if not options.tiny and not torch.cuda.is_available():
        raise SystemExit("expected a CUDA device, found none; --tiny runs on the CPU")
    device = torch.device("cpu" if options.tiny else "cuda")
    dtype = torch.float32 if options.tiny else torch.bfloat16
    width, height = map(int, options.size.split("x"))
    card = "cpu, tiny model" if options.tiny else torch.cuda.get_device_name(device)

    transformer = random_network(
        diffusers_library().FluxTransformer2DModel, TINY if options.tiny else REAL, device, dtype
    )
    settings = TINY_AUTOENCODER if options.tiny else AUTOENCODER
    autoencoder = Autoencoder(random_network(diffusers_library().AutoencoderKL, settings, device, dtype))
    prompt = PromptEmbedding(torch.randn(TOKENS, 4096), torch.randn(768)).to(device, dtype)
    network = FluxNetwork(transformer, autoencoder, prompt, "image-mask", device, dtype)
    rows: dict[str, dict[str, float]] = {}

    stock = parts(network, 1, (width, height), options.repeats)
    encode_text = text_encoders(device, options.tiny)
    if encode_text is None:
        print("transformers is not installed: stock is timed without its text encoders")
    else:
        stock["text"] = seconds(encode_text, device, options.repeats)
        stock["whole"] += stock["text"]
    rows["stock"] = stock

    bake(transformer, prompt, schnell_levels()[:-1])
    rows["ours, one view at a time"] = parts(network, 1, (width, height), options.repeats)
    rows[f"ours, {options.batch} views at once"] = parts(network, options.batch, (width, height), options.repeats)
    if not options.no_compile and not options.tiny:
        transformer.compile_repeated_blocks()
        compiled = parts(network, options.batch, (width, height), options.repeats)
        rows[f"compiled, {options.batch} views at once"] = compiled

    print(f"{card}, torch {torch.__version__}, {options.size}, seconds a view\n")
    columns = ("text", "encode", "steps", "decode", "whole")
    print(f"| | {' | '.join(columns)} |\n| --- |{' --- |' * len(columns)}")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{row[c]:.4f}' if c in row else '-' for c in columns)} |")
    best = min(row["whole"] for name, row in rows.items() if name != "stock")
    result = {"card": card, "seconds_per_view": round(best, 4), "times_stock": round(rows["stock"]["whole"] / best, 2)}
    if device.type == "cuda":
        result["peak_gb"] = round(torch.cuda.max_memory_allocated(device) / 1e9, 1)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
