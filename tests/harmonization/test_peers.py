"""Harmonisers by other authors: each works with stand-ins of its parts, and names missing parts in one line."""

import base64
import io
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from splatgraft.harmonization import (
    HarmonizerContext,
    HarmonizerInputs,
    ICLightOptions,
    ImageEditingOptions,
    make_harmonizer,
)
from splatgraft.harmonization.peers.image_editing import PROMPT
from splatgraft.harmonization.peers.mv_colight import MVCoLight, network_input


def view(h=40, w=60):
    g = torch.Generator().manual_seed(0)
    background = torch.rand(h, w, 3, generator=g)
    mask = torch.zeros(h, w)
    mask[10:20, 20:40] = 1
    composite = torch.where(mask[..., None] > 0, torch.rand(h, w, 3, generator=g), background)
    return HarmonizerInputs(composite, background, mask, torch.rand(h, w, generator=g), torch.zeros(h, w, 3), composite)


MISSING = {
    "lbm": "harmonizer lbm: expected the package lbm",
    "ic-light": "harmonizer ic-light: expected --weights iclight_sd15_fbc.safetensors",
    "mv-colight": "harmonizer mv-colight: expected --checkout with the code of",
    "image-editing": "--max-cost: expected at least 0.04 US dollars, found 0.00",
    "flux": "harmonizer flux: expected --weights FOLDER or a hub id",
}


@pytest.mark.parametrize("name", MISSING)
def test_what_is_missing_is_one_line(name):
    with pytest.raises(ValueError, match=MISSING[name]) as error:
        make_harmonizer(name)
    assert "\n" not in str(error.value)


def test_lbm_is_asked_and_kept_inside_the_object(monkeypatch):
    package, inference = ModuleType("lbm"), ModuleType("lbm.inference")
    package.__spec__ = sys.__spec__
    asked = []
    inference.get_model = lambda weights, **settings: asked.append((weights, settings["device"])) or "model"
    inference.evaluate = lambda model, image, steps: Image.new("RGB", (8, 8), (255, 0, 0))
    monkeypatch.setitem(sys.modules, "lbm", package)
    monkeypatch.setitem(sys.modules, "lbm.inference", inference)
    image = make_harmonizer("lbm").harmonize(view()).image
    assert asked == [("jasperai/LBM_relighting", "cpu")]
    assert torch.equal(image[view().mask == 0], view().composite[view().mask == 0])
    assert torch.equal(image[15, 30], torch.tensor([1.0, 0.0, 0.0]))


class Service(BaseHTTPRequestHandler):
    asked: list = []  # noqa: RUF012
    status = 200

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.asked.append((self.headers["x-goog-api-key"], body))
        picture = body["contents"][0]["parts"][1]["inline_data"]["data"]
        parts = [{"text": "here you are"}, {"inlineData": {"mimeType": "image/png", "data": picture}}]
        answer = {"candidates": [{"content": {"parts": parts}}]} if self.status == 200 else {"error": "quota"}
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(json.dumps(answer).encode())

    def log_message(self, *words):
        pass


@pytest.fixture
def service():
    server = HTTPServer(("127.0.0.1", 0), Service)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    Service.asked, Service.status = [], 200
    yield f"http://127.0.0.1:{server.server_port}/edit"
    server.shutdown()
    thread.join()
    server.server_close()


def test_an_editing_service_is_sent_the_paper_s_prompt_composite_and_mask(service):
    said = []
    options = ImageEditingOptions(weights=service, max_cost=0.2)
    image = make_harmonizer(options, HarmonizerContext(key="secret", views=3, say=said.append)).harmonize(view()).image
    assert (image - view().composite).abs().max() < 1 / 255  # the stand-in sends the composite back, in 8 bits
    key, body = Service.asked[0]
    text, _, mask = body["contents"][0]["parts"]
    assert key == "secret"
    assert text["text"] == PROMPT
    shown = np.array(Image.open(io.BytesIO(base64.b64decode(mask["inline_data"]["data"]))))
    assert set(np.unique(shown)) == {0, 255}
    assert "3 views" in said[0]
    assert "0.12 US dollars" in said[0]


def test_an_editing_service_that_fails_or_has_no_key_is_one_line(service):
    Service.status = 429
    options, context = ImageEditingOptions(weights=service, max_cost=1.0), HarmonizerContext(key="secret")
    with pytest.raises(ValueError, match=r"expected an answer, found status 429: .*quota"):
        make_harmonizer(options, context).harmonize(view())
    with pytest.raises(ValueError, match="expected a key in SPLATGRAFT_IMAGE_EDITING_KEY, found none"):
        make_harmonizer(ImageEditingOptions(weights=service, max_cost=1.0))
    with pytest.raises(ValueError, match="expected --weights https://"):
        make_harmonizer(ImageEditingOptions(weights="ftp://x", max_cost=1.0))


def test_mv_colight_runs_in_its_own_python_and_its_change_is_laid_on_the_composite(tmp_path):
    python = tmp_path / "python"
    program = tmp_path / "program.py"
    # called as: PYTHON - MODEL_FOLDER INPUT OUTPUT
    program.write_text("import sys, numpy as np; np.save(sys.argv[4], np.load(sys.argv[3])[:3] * 0.5)")
    python.write_text(f'#!/bin/sh\nexec {sys.executable} {program} "$@"\n')
    python.chmod(0o755)
    image = MVCoLight(tmp_path, tmp_path, python).harmonize(view()).image
    bright = view().composite.amin(-1) > 0.3
    # (x / 2 + 0.02) / (x + 0.02) at the network's size, above a half by less than 0.04 for x > 0.3
    assert ((image / view().composite)[bright] - 0.5).median() < 0.04
    assert network_input(view()).shape == (7, 256, 256)
    python.write_text("#!/bin/sh\necho 'ModuleNotFoundError: mmengine' >&2\nexit 1\n")
    with pytest.raises(ValueError, match="expected MV-CoLight to make a picture, found ModuleNotFoundError: mmengine"):
        MVCoLight(tmp_path, tmp_path, python).harmonize(view())


def test_ic_light_adds_its_difference_to_the_base(tmp_path):
    pytest.importorskip("diffusers")
    from tiny_models import removal_folder

    from splatgraft.harmonization.flux.weights.tensor_file import read_tensors, write_tensors

    base = removal_folder(tmp_path / "base")
    weights = read_tensors(base / "unet" / "diffusion_pytorch_model.safetensors")
    g = torch.Generator().manual_seed(0)
    weights["conv_in.weight"] = torch.cat([weights["conv_in.weight"]] * 3, 1)
    difference = {name: 0.01 * torch.randn(tensor.shape, generator=g) for name, tensor in weights.items()}
    path = tmp_path / "iclight_sd15_fbc.safetensors"
    write_tensors(path, difference)
    options = ICLightOptions(weights=str(path), base=str(base))
    image = make_harmonizer(options).harmonize(view()).image
    assert image.shape == (40, 60, 3)
    assert bool(image.isfinite().all())
    write_tensors(path, {name: tensor for name, tensor in difference.items() if name != "conv_in.weight"})
    with pytest.raises(ValueError, match=r"iclight_sd15_fbc.safetensors: expected conv_in.weight of .*, found none"):
        make_harmonizer(options)
