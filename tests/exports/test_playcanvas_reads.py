"""Scenes that we write, as the PlayCanvas engine reads them in Chromium: the reader of .glb that is not ours."""

import base64
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
import torch
from editor_driver import ARGUMENTS, browser_path
from waiting import HANG_LIMIT

from splatgraft import formats
from splatgraft.core.gaussians import Gaussians

sys.path.append(str(Path(__file__).parents[1] / "formats"))
from test_scenes_of_other_tools import GLB, TOOLS, assert_within

ENGINE = files("splatgraft.exports") / "viewer" / "playcanvas.js"
READ = """async ([text, kind]) => {
  const device = new pc.WebglGraphicsDevice(document.getElementById("canvas"), {});
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler, pc.ContainerHandler];
  const app = new pc.AppBase(document.getElementById("canvas"));
  app.init(options);
  const contents = Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const asset = new pc.Asset("scene", kind, { url: "scene.glb", filename: "scene.glb", contents });
  await new Promise((resolve, reject) => {
    asset.once("load", resolve);
    asset.once("error", (error) => reject(new Error(error)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const data = asset.resource.gsplats.flat()[0].resource.gsplatData;
  const found = {};
  for (const { name } of data.getElement("vertex").properties) found[name] = [...data.getProp(name)];
  return found;
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A page with the engine."""
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=list(ARGUMENTS), timeout=1000 * HANG_LIMIT)
        page = found.new_page()
        page.set_content('<canvas id="canvas"></canvas>')
        page.add_script_tag(content=ENGINE.read_text(encoding="utf-8"))
        yield page
        found.close()


def test_the_engine_reads_our_glb(browser, tmp_path):
    original = formats.read_gaussians(TOOLS / "scene.ply")
    formats.write_gaussians(tmp_path / "scene.glb", original)
    text = base64.b64encode((tmp_path / "scene.glb").read_bytes()).decode()
    columns = {name: torch.tensor(values) for name, values in browser.evaluate(READ, [text, "container"]).items()}

    def stacked(*names: str) -> torch.Tensor:
        return torch.stack([columns[name] for name in names], 1)

    rest = stacked(*(f"f_rest_{i}" for i in range(45))).reshape(40, 3, 15).transpose(1, 2)
    found = Gaussians(  # the engine keeps linear scales and opacities of a .glb
        means=stacked("x", "y", "z"),
        log_scales=stacked("scale_0", "scale_1", "scale_2").log(),
        quaternions=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logits=columns["opacity"].logit(),
        sh=torch.cat([stacked("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], 1),
    )
    from splatgraft.formats.scenes.axes import change_axes, rdf_from

    assert_within(original, change_axes(found, rdf_from("LUF")), GLB)
