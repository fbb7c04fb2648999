"""Measure size, seconds and PSNR of every format that `splatgraft export` writes, against the .ply.

`python benchmarks/export.py PROJECT [--chromium]`. PROJECT is a project's folder, e.g. of `splatgraft demo`.
PSNR is the mean over eight of the target's views: our reader reads the file and our renderer draws it. For the .html,
the picture in Chromium (playwright), without a network, is compared with ours. The size of an .html includes both
scenes and the viewer. The last line is the scene with band 0 alone.
"""

import io
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.export import ExportOptions, export_scene
from splatgraft.exports.export_source import ExportSource, first_view
from splatgraft.folders.export_source import read_export_source
from splatgraft.formats import read_gaussians
from splatgraft.rendering import render

FORMATS = (".ply", ".compressed.ply", ".sog", ".spz", "3.spz", ".splat", ".glb", ".html")
VIEWS, LONGEST_PX, PAGE_PX = 8, 640, 960
_ARGUMENTS = ("--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean().clamp_min(1e-12)))


def mean_psnr(scene: Gaussians, truth: list[torch.Tensor], cameras: Cameras) -> float:
    pairs = zip(truth, cameras, strict=True)
    return sum(psnr(render(scene, camera).color[0].clamp(0, 1), picture) for picture, camera in pairs) / len(truth)


def page_psnr(path: Path, source: ExportSource) -> tuple[float, float]:
    """Return PSNR of the page's first view in Chromium, and seconds until it is drawn."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    camera = first_view(source)[0].camera(PAGE_PX)
    with sync_playwright() as driver:
        path_of_browser = shutil.which("chromium") or driver.chromium.executable_path
        browser = driver.chromium.launch(executable_path=path_of_browser, args=list(_ARGUMENTS))
        page = browser.new_context(offline=True, viewport={"width": PAGE_PX, "height": camera.height}).new_page()
        start = time.perf_counter()
        page.goto(path.as_uri())
        page.wait_for_selector("body[data-state=ready]", timeout=600_000)
        seconds = time.perf_counter() - start
        page.add_style_tag(content="h1, .corner, .bar, #divider { opacity: 0 }")
        page.keyboard.press("b")  # the result alone, if there are two scenes
        page.wait_for_selector("body[data-still=true]", timeout=600_000)
        shown = torch.from_numpy(np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))).float() / 255
        browser.close()
    return psnr(shown, render(source.scene, camera).color[0].clamp(0, 1)), seconds


def main() -> None:
    source = read_export_source(Path(sys.argv[1]))
    assert source.cameras is not None
    cameras = source.cameras.spread(VIEWS)
    cameras = cameras.resized(LONGEST_PX / float(cameras.sizes.max()))
    truth = [render(source.scene, camera).color[0].clamp(0, 1) for camera in cameras]
    print(f"{source.scene.count:,} Gaussians, SH degree {source.scene.sh_degree}")
    print("| format | MB | of the .ply | seconds | PSNR, dB |\n| --- | --- | --- | --- | --- |")
    whole = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            path = Path(folder) / f"scene{name}"
            version = int(name[0]) if name[0].isdigit() else 4
            start = time.perf_counter()
            try:
                export_scene(source, path, ExportOptions(frame="capture", spz_version=version))
            except ModuleNotFoundError as error:
                print(f"| {name} | | | | {error.name} is not installed |")
                continue
            seconds, size = time.perf_counter() - start, path.stat().st_size
            whole = whole or size
            quality = "not measured"
            if name == ".html" and "--chromium" in sys.argv:
                value, opened = page_psnr(path, source)
                quality = f"{value:.1f} in Chromium, drawn after {opened:.1f} s"
            elif name != ".html":
                value = mean_psnr(read_gaussians(path), truth, cameras)
                quality = "exact" if value > 100 else f"{value:.1f}"
            label = f".spz, version {version}" if name.endswith(".spz") else name
            print(f"| `{label}` | {size / 1e6:.2f} | {size / whole:.0%} | {seconds:.1f} | {quality} |", flush=True)
    print(f"band 0 alone: {mean_psnr(source.scene.with_sh_degree(0), truth, cameras):.1f} dB")


if __name__ == "__main__":
    main()
