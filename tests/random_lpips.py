"""Random weights in the file layout of LPIPS's published ones."""

import torch

from splatgraft.fitting.perceptual_losses import HEADS_FILE, VGG_FILE


def write_random_lpips(folder):
    """Write both files into a folder."""
    generator = torch.Generator().manual_seed(0)
    vgg, below = {}, 3
    channels = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256}
    channels |= dict.fromkeys((17, 19, 21, 24, 26, 28), 512)
    for layer, above in channels.items():
        vgg[f"features.{layer}.weight"] = torch.randn(above, below, 3, 3, generator=generator) * (2 / below / 9) ** 0.5
        vgg[f"features.{layer}.bias"] = 0.1 * torch.randn(above, generator=generator)
        below = above
    torch.save(vgg, folder / VGG_FILE)
    heads = {
        f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=generator)
        for i, c in enumerate((64, 128, 256, 512, 512))
    }
    torch.save(heads, folder / HEADS_FILE)
