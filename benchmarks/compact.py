"""Measure the time of the compact harmoniser on a CPU, with random images and weights: `python benchmarks/compact.py`.

Prints the core-seconds per view at 704x496, and those of the network alone.
"""

import time

import torch

from splatgraft.harmonization import HarmonizerInputs
from splatgraft.harmonization.compact.harmonizer import Compact
from splatgraft.harmonization.compact.network import CompactNetwork

WIDTH, HEIGHT, VIEWS = 704, 496, 8


def example() -> HarmonizerInputs:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    mask = torch.zeros(HEIGHT, WIDTH)
    mask[150:350, 250:450] = 1
    normal = torch.nn.functional.normalize(torch.randn(HEIGHT, WIDTH, 3, generator=generator), dim=-1)
    return HarmonizerInputs(image, image, mask, torch.ones(HEIGHT, WIDTH), normal, 0.8 * image, prior_confidence=0.5)


def main() -> None:
    network = CompactNetwork()
    harmonizer = Compact(network.eval(), device=torch.device("cpu"))
    view = example()
    harmonizer.harmonize(view)
    began = time.process_time()
    for _ in range(VIEWS):
        harmonizer.harmonize(view)
    seconds = (time.process_time() - began) / VIEWS
    channels = torch.rand(1, 16, 176, 256)
    began = time.process_time()
    with torch.no_grad():
        for _ in range(VIEWS):
            network(channels)
    network_seconds = (time.process_time() - began) / VIEWS
    parameters = sum(p.numel() for p in network.parameters())
    print(f"parameters={parameters / 1e6:.2f}M core_seconds={seconds:.3f} network_core_seconds={network_seconds:.3f}")


if __name__ == "__main__":
    main()
