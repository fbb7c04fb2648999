"""Measure everything on a machine with one CUDA card and no network: `python benchmarks/gpu.py --out DIR`.

Each part runs in a process of its own, which is stopped after ten minutes (`--limit`). A finished part is not run
again, so the same command continues after a stop. DIR/gpu.json and DIR/gpu.md hold all results with the card's name,
after each part. DIR/NAME.log holds the output of a failed part. `--toy` runs the same code at toy size on the CPU; its
figures mean nothing.

    cuda-tests    tests/rendering/test_cuda.py
    renderer      gsplat against the CPU rasteriser: pictures, gradients, W and its transpose; milliseconds
    reconstruct   data/room and --captures (with poses), draft and full with 7000 steps: dB on held-out views, seconds
    paper-size    benchmarks/paper_size.py: lift, relight, render, consolidate
    paper-adam    seconds of the paper's 10,000 steps of Adam on LPIPS, VGG-16 with random weights
    harmonize-*   a random-weight harmoniser of the real size at 704x496: stock diffusers and ours; stored in fp8
    lora          one training step of a low-rank adaptation of that network
"""

import argparse
import json
import math
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[1]
LIMIT_S = 600
Row = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """Arguments of a part."""

    device: torch.device
    toy: bool
    captures: tuple[Path, ...] = ()
    """Captures with poses, reconstructed beside data/room."""

    @property
    def repeats(self) -> int:
        """Number of timed runs; their median counts."""
        return 1 if self.toy else 5

    def synchronize(self) -> None:
        """Wait for the card."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def peak_gb(self) -> float:
        """Return the card's peak memory since the part began, GB; 0 on the CPU."""
        return torch.cuda.max_memory_allocated(self.device) / 1e9 if self.device.type == "cuda" else 0.0


def cuda_tests(setting: Setting) -> list[Row]:
    """Run the renderer's tests that need a card, and count them by result."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-o",
        "filterwarnings=",
        str(ROOT / "tests/rendering/test_cuda.py"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    last = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr.strip()[-200:]
    if not setting.toy and done.returncode:
        print(done.stdout)
        raise RuntimeError(last)
    return [{"tests": last}]


def renderer(setting: Setting) -> list[Row]:
    """Measure the differences of the two rasterisers, and the card's milliseconds."""
    from relight import courtyard

    from splatgraft.core.cameras import look_at, pinhole
    from splatgraft.rendering import render, view_operator

    rows: list[Row] = []
    up = torch.tensor([0.0, 0.0, 1.0])
    pose = look_at(torch.tensor([[2.0, 0.5, 1.2]]), torch.zeros(3), up)
    for count, width, height in [(300, 48, 32)] if setting.toy else [(30_000, 352, 248), (300_000, 704, 496)]:
        camera = pinhole(pose, 0.85 * width, width=width, height=height)
        pictures, gradients = [], []
        for device in (torch.device("cpu"), setting.device):
            scene = courtyard(count).with_sh_degree(3).to(device).map(lambda t: t.detach().requires_grad_())
            color = render(scene, camera.to(device)).color
            (color**2).mean().backward()
            assert scene.means.grad is not None
            assert scene.sh.grad is not None
            pictures.append(color.detach().cpu())
            gradients.append((scene.means.grad.cpu(), scene.sh.grad.cpu()))
        operator = view_operator(courtyard(count).to(setting.device), camera.to(setting.device))
        values = torch.randn(count, 3, device=setting.device)
        image = torch.randn(height, width, 3, device=setting.device)
        sides = (operator.blend(values) * image).sum(), (operator.blend_transpose(image) * values).sum()
        scene = courtyard(count).with_sh_degree(3).to(setting.device)
        rows.append(
            {
                "gaussians": count,
                "size": f"{width}x{height}",
                "picture_rmse": float((pictures[0] - pictures[1]).square().mean().sqrt()),
                "gradient_error_means": _relative(gradients[0][0], gradients[1][0]),
                "gradient_error_sh": _relative(gradients[0][1], gradients[1][1]),
                "adjoint_error": float((sides[0] - sides[1]).abs() / (values.norm() * image.norm())),
                "forward_ms": 1000 * _median(lambda: render(scene, camera.to(setting.device)), setting),  # noqa: B023
            }
        )
    return rows


def reconstruct_captures(setting: Setting) -> list[Row]:
    """Measure quality and time of reconstructions: a draft, and `full` (a million Gaussians) with 7000 steps."""
    from splatgraft.core.image_metrics import psnr
    from splatgraft.core.posed_images import held_out
    from splatgraft.formats import read_capture
    from splatgraft.reconstruction import ReconstructOptions, reconstruct
    from splatgraft.rendering import render

    toy = {"iterations": 3, "budget": 500, "resolution": 0.15}
    device = setting.device.type
    draft = ReconstructOptions(quality="draft", device=device, eval_every=8)
    full = ReconstructOptions(quality="full", iterations=7000, device=device, eval_every=8)
    rows: list[Row] = []
    for folder in (ROOT / "data" / "room", *setting.captures):
        capture = read_capture(folder)
        for options in (replace(one, **toy) if setting.toy else one for one in (draft, full)):
            begin = time.perf_counter()
            scene = reconstruct(capture, options)
            setting.synchronize()
            seconds = time.perf_counter() - begin
            served = options.served(capture)
            chosen = [i for i in range(len(served)) if held_out(len(served))[i]][: 1 if setting.toy else None]
            scene = scene.to(setting.device)
            views = ((served.cameras[i].to(setting.device), served.image(i)) for i in chosen)
            with torch.no_grad():
                found = [psnr(render(scene, camera).color[0].clamp(0, 1).cpu(), image) for camera, image in views]
            cost = {"seconds": seconds, "gaussians": scene.count, "peak_gb": setting.peak_gb()}
            row = {
                "capture": folder.name,
                "photos": len(served),
                "longest_px": int(served.cameras.sizes.max()),
            }
            rows.append({**row, "quality": options.quality, "psnr": float(torch.stack(found).mean()), **cost})
            print(rows[-1], flush=True)
    return rows


def paper_size(setting: Setting) -> list[Row]:
    """Measure the paper's work after reconstruction; on a card at its size with 300,000 and 1,000,000 Gaussians."""
    from paper_size import Size, measure

    if setting.toy:
        sizes = [Size(views=10, width=48, height=32, gaussians=600, passes=1)]
    else:
        sizes = [Size(200, 704, 496, count, setting.device.type) for count in (300_000, 1_000_000)]
    rows: list[Row] = []
    for size in sizes:
        found = measure(size, say=lambda _: None)
        parts = found.pop("parts")
        assert isinstance(parts, list)
        times = {f"{one['part']}_s": one["seconds"] for one in parts}
        counts = {"gaussians": size.gaussians, "gaussians_relit": found["gaussians_relit"], "views": size.views}
        rows.append({**counts, **times, "peak_mb": parts[-1]["peak_mb"]})
    return rows


def paper_adam(setting: Setting) -> list[Row]:
    """Measure the paper's consolidation (its section 6): the time of a step, and of 10,000."""
    from paper_size import Size, scene_of

    from splatgraft.fitting.perceptual_losses import lpips_vgg
    from splatgraft.rendering import render
    from splatgraft_paper.consolidation import PaperDescent, descend_as_paper

    size = Size(4, 48, 32, 600) if setting.toy else Size(40, 704, 496, 300_000)
    composite, cameras, _ = scene_of(size)
    scene, cameras = composite.merged()[0].to(setting.device), cameras.to(setting.device)
    with torch.no_grad():
        images = [0.9 * render(scene, camera).color[0].clamp(0, 1) for camera in cameras]
    sys.path.append(str(ROOT / "tests"))
    from random_lpips import write_random_lpips

    with tempfile.TemporaryDirectory() as folder:
        write_random_lpips(Path(folder))
        loss = lpips_vgg(Path(folder))
    times = []
    for steps in (2, 4) if setting.toy else (50, 350):
        begin = time.perf_counter()
        descend_as_paper(scene, cameras, images, PaperDescent(loss, iterations=steps))
        setting.synchronize()
        times.append((time.perf_counter() - begin, steps))
    step = (times[1][0] - times[0][0]) / (times[1][1] - times[0][1])
    row = {"gaussians": scene.count, "size": f"{size.width}x{size.height}", "ms_a_step": 1000 * step}
    return [{**row, "seconds_of_10000": 10_000 * step, "peak_gb": setting.peak_gb()}]


def harmonize_plain(setting: Setting) -> list[Row]:
    """Measure stock diffusers, then our code with the modulations in a table."""
    from splatgraft.harmonization.flux.baked_modulation import bake
    from splatgraft.harmonization.flux.sampling import schnell_levels

    network, size = _network(setting)
    rows = [{"kind": "stock", **_harmonize_times(network, size, setting), "peak_gb": setting.peak_gb()}]
    bake(network.transformer, network.prompt, schnell_levels()[:-1])
    return [*rows, {"kind": "ours", **_harmonize_times(network, size, setting), "peak_gb": setting.peak_gb()}]


def harmonize_fp8(setting: Setting) -> list[Row]:
    """Measure weights stored in 8 bits and cast layer by layer, as `--precision fp8` does."""
    network, size = _network(setting)
    network.transformer.enable_layerwise_casting(storage_dtype=torch.float8_e4m3fn, compute_dtype=network.dtype)
    return [{"kind": "fp8 stored", **_harmonize_times(network, size, setting), "peak_gb": setting.peak_gb()}]


def lora_step(setting: Setting) -> list[Row]:
    """Measure seconds of forward, backward and Adam on a low-rank adaptation, with frozen weights in bf16."""
    from splatgraft.harmonization.flux.network import velocity
    from splatgraft_paper.training.flux import add_lora

    network, (width, height) = _network(setting)
    layers = add_lora(network.transformer, 4 if setting.toy else 16, seed=0)
    trained = [p for p in network.transformer.parameters() if p.requires_grad]
    network.transformer.enable_gradient_checkpointing()
    network.transformer.train()
    optimizer = torch.optim.Adam(trained, lr=3e-5)
    shape = (1, 48, math.ceil(height / 16) * 2, math.ceil(width / 16) * 2)
    latents = torch.randn(shape, device=setting.device, dtype=network.dtype)
    wanted = torch.randn(1, 16, *shape[2:], device=setting.device, dtype=network.dtype)
    level = torch.full((1,), 0.5, device=setting.device, dtype=network.dtype)

    def step() -> None:
        optimizer.zero_grad()
        # as the training does: fp32 weights of the adaptation, arithmetic in bf16
        with torch.autocast(setting.device.type, torch.bfloat16, enabled=network.dtype == torch.bfloat16):
            found = velocity(network.transformer, latents, level, network.prompt)
        (found - wanted).float().square().mean().backward()
        optimizer.step()

    seconds = _median(step, setting)
    assert all(p.grad is not None for p in trained)
    count = sum(p.numel() for p in trained)
    return [{"layers": layers, "parameters": count, "seconds_a_step": seconds, "peak_gb": setting.peak_gb()}]


PARTS: Mapping[str, Callable[[Setting], list[Row]]] = {
    "cuda-tests": cuda_tests,
    "renderer": renderer,
    "reconstruct": reconstruct_captures,
    "paper-size": paper_size,
    "paper-adam": paper_adam,
    "harmonize-plain": harmonize_plain,
    "harmonize-fp8": harmonize_fp8,
    "lora": lora_step,
}


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


def _random_network(kind: Any, settings: dict[str, Any], device: torch.device, dtype: torch.dtype) -> Any:
    """Make a network with random weights directly on the device, so that 24 GB need not pass through the CPU."""
    torch.manual_seed(0)
    with torch.device(device):
        default = torch.get_default_dtype()
        torch.set_default_dtype(dtype)
        try:
            return kind(**settings).eval().requires_grad_(False)
        finally:
            torch.set_default_dtype(default)


def _network(setting: Setting) -> tuple[Any, tuple[int, int]]:
    """Return the harmoniser with random weights, of the real size or tiny, and the size of its images."""
    from splatgraft.harmonization.flux.loading import diffusers_library
    from splatgraft.harmonization.flux.network import Autoencoder, FluxNetwork
    from splatgraft.harmonization.flux.prompt import PromptEmbedding

    dtype = torch.float32 if setting.toy else torch.bfloat16
    transformer = _random_network(
        diffusers_library().FluxTransformer2DModel, TINY if setting.toy else REAL, setting.device, dtype
    )
    weights = TINY_AUTOENCODER if setting.toy else AUTOENCODER
    autoencoder = Autoencoder(_random_network(diffusers_library().AutoencoderKL, weights, setting.device, dtype))
    tokens = 8 if setting.toy else TOKENS
    prompt = PromptEmbedding(torch.randn(tokens, 4096), torch.randn(768)).to(setting.device, dtype)
    network = FluxNetwork(transformer, autoencoder, prompt, "image-mask", setting.device, dtype)
    return network, (32, 32) if setting.toy else (704, 496)


def _relative(wanted: torch.Tensor, found: torch.Tensor) -> float:
    return float((wanted - found).norm() / wanted.norm())


def _median(work: Callable[[], object], setting: Setting) -> float:
    """Return median seconds of `work` after two warm-up runs."""
    times = []
    for i in range(setting.repeats + 2):
        begin = time.perf_counter()
        work()
        setting.synchronize()
        if i >= 2:
            times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _harmonize_times(network: Any, size: tuple[int, int], setting: Setting) -> Row:
    """Measure seconds of encoding, the four sampling steps, decoding, and the whole harmonisation of a view."""
    from splatgraft.harmonization import HarmonizerInputs
    from splatgraft.harmonization.flux.harmonizer import FluxHarmonizer
    from splatgraft.harmonization.flux.network import pad_by_reflection, velocity
    from splatgraft.harmonization.flux.sampling import noise, sample, schnell_levels

    (width, height), device = size, network.device
    pictures = torch.rand(2, 3, height, width)
    padded = pad_by_reflection(pictures).to(device)
    h, w = padded.shape[2] // 8, padded.shape[3] // 8
    conditions, start = torch.randn(1, 32, h, w, device=device), noise((16, h, w), 0).to(device)[None]

    def step(latents: torch.Tensor, level: float) -> torch.Tensor:
        joined = torch.cat([latents, conditions], 1).to(network.dtype)
        return velocity(network.transformer, joined, torch.tensor([level], device=device), network.prompt)

    flat, image = torch.zeros(height, width), pictures[0].permute(1, 2, 0).contiguous()
    view = HarmonizerInputs(image, image, flat, flat, image)
    harmonizer = FluxHarmonizer(network)
    work: dict[str, Callable[[], object]] = {
        "encode": lambda: network.autoencoder.encode(padded),
        "steps": lambda: sample(step, start, schnell_levels()),
        "decode": lambda: network.autoencoder.decode(start),
        "whole": lambda: harmonizer.harmonize(view),
    }
    return {name: _median(run, setting) for name, run in work.items()}


def run_part(name: str, setting: Setting, out: Path) -> None:
    """Run one part in this process and write OUT/NAME.json."""
    begin = time.perf_counter()
    rows = PARTS[name](setting)
    record = {"part": name, "toy": setting.toy, "seconds": round(time.perf_counter() - begin, 1), "rows": rows}
    (out / f"{name}.json").write_text(json.dumps(record, indent=1), encoding="utf-8")


def is_finished(path: Path, *, toy: bool) -> bool:
    """Return whether a part's file holds a result of the same size."""
    return path.is_file() and json.loads(path.read_text(encoding="utf-8")).get("toy") == toy


def write_report(out: Path, names: list[str], failures: Mapping[str, str], card: str) -> None:
    """Write gpu.json and gpu.md from the parts that are finished."""
    found = [json.loads(path.read_text(encoding="utf-8")) for name in names if (path := out / f"{name}.json").is_file()]
    head = {"card": card, "torch": torch.__version__, "python": platform.python_version()}
    (out / "gpu.json").write_text(
        json.dumps({**head, "parts": found, "failures": dict(failures)}, indent=1), encoding="utf-8"
    )
    text = [f"# {card}", f"torch {torch.__version__}, Python {platform.python_version()}"]
    for record in found:
        columns = list(dict.fromkeys(key for row in record["rows"] for key in row))
        lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
        lines += ["| " + " | ".join(_cell(row.get(column)) for column in columns) + " |" for row in record["rows"]]
        text += [f"## {record['part']} ({record['seconds']} s)", "\n".join(lines)]
    text += [f"- {name} failed: {reason}" for name, reason in failures.items()]
    (out / "gpu.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu"))
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds a part may take")
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="captures with poses, also reconstructed")
    parser.add_argument("--toy", action="store_true", help="toy size on the CPU")
    parser.add_argument("--here", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not args.toy and not torch.cuda.is_available():
        raise SystemExit("gpu: expected a CUDA device that torch can use, found none; --toy runs on the CPU")
    args.out.mkdir(parents=True, exist_ok=True)
    setting = Setting(torch.device("cpu" if args.toy else "cuda"), args.toy, tuple(args.captures))
    if args.here:
        run_part(args.here, setting, args.out)
        return 0
    card = "cpu, toy size" if args.toy else torch.cuda.get_device_name()
    failures: dict[str, str] = {}
    for name in args.parts:
        if is_finished(args.out / f"{name}.json", toy=args.toy):
            print(f"{name}: finished earlier", flush=True)
            continue
        command = [sys.executable, __file__, "--out", str(args.out), "--here", name, *(["--toy"] if args.toy else [])]
        command += ["--captures", *map(str, args.captures)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=args.limit, check=False)
            if done.returncode:
                (args.out / f"{name}.log").write_text(done.stdout + done.stderr, encoding="utf-8")
                lines = done.stderr.strip().splitlines()
                failures[name] = lines[-1] if lines else f"exit {done.returncode}"
        except subprocess.TimeoutExpired as stopped:
            (args.out / f"{name}.log").write_bytes(stopped.stdout or b"")
            failures[name] = f"stopped after {args.limit:.0f} s"
        print(f"{name}: {failures.get(name, 'done')}", flush=True)
        write_report(args.out, list(PARTS), failures, card)
    write_report(args.out, list(PARTS), failures, card)
    print(args.out / "gpu.md")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
