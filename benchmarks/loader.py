"""Pairs a second that the training's loader reads for a network that takes no time.

`python benchmarks/loader.py` measures pairs of the paper's size, made of the shipped photographs, from folders and
packed (`synth pack`), with several numbers of threads (`train flux --readers`):

- pictures: the first time that a pair is drawn; four PNGs are decoded, composed (paper, Eq. 2) and cut to size;
- latents: every later time; the cached latents of three pictures are read and stacked.

`--pairs` and `--generated` measure your own, as `train flux` takes them: folders, or packed pairs at an address. Files
that were just written are in the system's page cache: a disk or network that is slower than the decoding is not
measured then. One line per row, and a last line of JSON:

    source=packed what=pictures readers=4 pairs_per_second=.. cpu_seconds_a_pair=.. h100s=..

h100s: GPUs of the paper that this one process could feed; the paper trained 50,000 steps of 4 pairs in two days on
four H100, so one takes 0.29 pairs a second. In a training each GPU has a process with a loader of its own.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as cli.py does; read when torch is loaded

import torch
from jaxtyping import Float
from torch import Tensor

import splatgraft
from splatgraft.core.images import list_images, read_mask, read_rgb
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.pair_loader import PairLoader
from splatgraft_paper.training.sources.packed_pairs import PackedPairs, pack_pairs
from splatgraft_paper.training.sources.pair_source import Mixture, PairSource, Role, crop_to_size, split_mixture
from splatgraft_paper.training.sources.relit_pairs import RelitPairs, RelitSample, write_manifest, write_sample
from splatgraft_paper.training.training_data import DataOptions, open_training_data

PAPER_PAIRS_PER_SECOND = 50_000 * 4 / (2 * 24 * 3600) / 4
"""Of one H100: 50,000 steps of 4 pairs, about two days, four GPUs (paper, Sec. 5.3)."""
ROLES: tuple[Role, ...] = ("composite", "mask", "target")
"""What the paper's harmoniser is trained on."""
_PHOTOGRAPHS = Path(splatgraft.__file__).parent / "demo_captures" / "bananas"
_LATENT_CHANNELS, _PIXELS_A_LATENT = 16, 8
"""Of FLUX's autoencoder."""


@dataclass(frozen=True)
class Size:
    """How much work."""

    width: int = 704
    height: int = 496
    photographs: int = 16
    """Each makes two pairs."""
    steps: int = 12
    """Of each row."""
    batch: int = 4
    readers: tuple[int, ...] = (0, 1, 2, 4)


@dataclass(frozen=True)
class Row:
    """One measurement."""

    source: str
    what: str
    readers: int
    pairs_per_second: float
    cpu_seconds_a_pair: float
    """Of all threads: what a pair costs however busy the machine is."""
    h100s: float
    """How many of the paper's GPUs that would feed."""


def write_pairs(folder: Path, size: Size) -> RelitPairs:
    """Pairs of the shipped photographs, their light changed by a gain per channel."""
    folder.mkdir(parents=True)
    for path in list_images(_PHOTOGRAPHS / "images")[: size.photographs]:
        target = crop_to_size(read_rgb(path), size.width, size.height).clamp(0, 1)
        mask = crop_to_size(read_mask(_PHOTOGRAPHS / "masks" / f"{path.stem}.png"), size.width, size.height).round()
        background = torch.where(mask[..., None] > 0, target.mean((0, 1)), target)
        relit = [(target * torch.tensor(gain)).clamp(0, 1) for gain in ((0.6, 0.8, 1.0), (1.0, 0.7, 0.4))]
        write_sample(folder / path.stem, RelitSample(target, background, mask, relit), {"group": path.stem})
    write_manifest(folder)
    return RelitPairs(folder)


def measure(sources: dict[str, PairSource], size: Size, work: Path, say: Callable[[str], None] = print) -> list[Row]:
    """Stream pairs and latents of all sources with all numbers of threads; latents are cached in `work`."""
    rows = []
    for name, source in sources.items():
        mixture, _ = split_mixture([source], weights=(), held_out=0.0, seed=0)
        for what in ("pictures", "latents"):
            cache = LatentCache(work / what / name, _fake_latents, width=size.width, height=size.height, autoencoder="")
            if what == "latents":
                for reference in mixture.all():
                    cache.encode_missing([cache.load(reference, ROLES)], ROLES)
            for readers in size.readers:
                speed, cpu = _speed(mixture, cache, size, readers)
                h100s = round(speed / PAPER_PAIRS_PER_SECOND, 1)
                rows.append(Row(name, what, readers, round(speed, 2), round(cpu, 5), h100s))
                shown = " ".join(f"{key}={value}" for key, value in asdict(rows[-1]).items())
                say(shown)
    return rows


def _speed(mixture: Mixture, cache: LatentCache, size: Size, readers: int) -> tuple[float, float]:
    """Pairs a second of a network that takes no time, and CPU-seconds a pair."""
    loop = LoopOptions(steps=size.steps, batch=size.batch, readers=readers)
    loader = PairLoader(mixture, cache, ROLES, loop=loop, rank=0, count=1)
    began, cpu, count = time.perf_counter(), time.process_time(), 0
    for step in range(size.steps):
        for loaded in loader.batches(step):
            # pictures would now be encoded on the card, which is not the loader's time
            if not loaded[0].pictures:
                cache.encode_missing(loaded, ROLES)
            count += len(loaded)
    spent = time.perf_counter() - began
    loader.close()
    return count / spent, (time.process_time() - cpu) / count


def _fake_latents(images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
    """Numbers of the size that FLUX's autoencoder gives."""
    h, w = images.shape[2] // _PIXELS_A_LATENT, images.shape[3] // _PIXELS_A_LATENT
    return torch.randn(len(images), _LATENT_CHANNELS, h, w)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default=f"{Size.width}x{Size.height}", help="pixels")
    parser.add_argument("--steps", type=int, default=Size.steps, help="of 4 pairs, of each row")
    parser.add_argument("--readers", type=int, nargs="+", default=Size.readers, help="numbers of threads")
    parser.add_argument("--pairs", nargs="+", default=(), help="read these instead, as train flux --pairs")
    parser.add_argument("--generated", nargs="+", default=(), help="read these instead, as train flux --generated")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    size = Size(width, height, steps=args.steps, readers=tuple(args.readers))
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if args.pairs or args.generated:
            given = DataOptions(pairs=tuple(args.pairs), generated=tuple(args.generated), size=args.size, held_out=0.0)
            opened = open_training_data(given, 0, None).mixture.sources
            sources: dict[str, PairSource] = {f"given{number}": source for number, source in enumerate(opened)}
        else:
            folders = write_pairs(work / "pairs", size)
            pack_pairs([folders], work / "packed", shard_bytes=2**30)
            sources = {"folders": folders, "packed": PackedPairs(str(work / "packed"))}
        rows = measure(sources, size, work / "latents")
    found = {"cores": len(os.sched_getaffinity(0)), "threads_of_torch": torch.get_num_threads()}
    print(json.dumps({**asdict(size), **found, "rows": [asdict(row) for row in rows]}))


if __name__ == "__main__":
    main()
