"""Pairs made of the shipped photographs of bananas: relit by a gain a channel, the object painted over."""

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from splatgraft.core.images import list_images, read_mask, read_rgb, resize, write_image
from splatgraft_paper.training.pairs import RelitSample, write_relit_manifest, write_sample

BANANAS = Path(__file__).parents[2] / "src" / "splatgraft" / "demo_captures" / "bananas"


def shipped_samples(count, side=32):
    for path in list_images(BANANAS / "images")[:count]:
        target = resize(read_rgb(path), side, side).clamp(0, 1)
        mask = (resize(read_mask(BANANAS / "masks" / f"{path.stem}.png"), side, side) > 0.5).float()
        hole = cv2.dilate(mask.numpy(), np.ones((3, 3))).astype(np.uint8)
        pixels = (target.numpy() * 255).astype(np.uint8)
        background = torch.from_numpy(cv2.inpaint(pixels, hole, 3, cv2.INPAINT_TELEA)).float() / 255
        relit = [(target * torch.tensor(gain)).clamp(0, 1) for gain in ((0.6, 0.8, 1.0), (1.0, 0.7, 0.4))]
        yield path.stem, RelitSample(target, background, mask, relit)


def relit_folder(folder: Path, count=3, side=32) -> Path:
    """Write the layout of generated pairs."""
    for name, sample in shipped_samples(count, side):
        folder.mkdir(parents=True, exist_ok=True)
        write_sample(folder / name, sample, {"group": name, "licence": "shipped photograph"})
    write_relit_manifest(folder)
    return folder


def rendered_folder(folder: Path, count=2, side=32) -> Path:
    """Write the layout of `splatgraft paper synth pairs`, one camera a scene."""
    lines = []
    for name, sample in shipped_samples(count, side):
        scene = folder / f"scene_{name}"
        for take in ("background", "object0", "object0_light0"):
            (scene / take).mkdir(parents=True)
        write_image(scene / "background" / "0000.png", sample.background)
        write_image(scene / "object0" / "0000.png", sample.target)
        write_image(scene / "object0" / "0000_mask.png", sample.mask[..., None].expand(-1, -1, 3).contiguous())
        write_image(scene / "object0_light0" / "0000.png", sample.relit[0])
        lines.append(json.dumps({"folder": scene.name, "camera": 0, "object": "object0", "light": "light0"}))
    (folder / "manifest.jsonl").write_text("\n".join(lines) + "\n")
    return folder
