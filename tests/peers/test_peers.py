"""Harmonisers by other authors and the baseline: stand-ins of their parts, missing parts named in one line."""

import base64
import io
import json
import re
import sys
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image
from shapes import ring

from splatgraft.cli import main
from splatgraft.core.images import read_rgb
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import HarmonizerContext, HarmonizerInputs, make_harmonizer
from splatgraft.harmonization.image_editing import PROMPT
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.peers.image_editing import KEY_VARIABLE, ImageEditingOptions
from splatgraft_paper.peers.methods import OptionWords, named_options
from splatgraft_paper.peers.mv_colight import MVCoLight, network_input


def view(h=40, w=60):
    g = torch.Generator().manual_seed(0)
    background = 0.3 + 0.2 * torch.rand(h, w, 3, generator=g)
    mask = torch.zeros(h, w)
    mask[12:28, 20:40] = 1
    composite = torch.where(mask[..., None] > 0, torch.rand(h, w, 3, generator=g), background)
    depth = torch.rand(h, w, generator=g)
    return HarmonizerInputs(composite, background, mask, depth, 0.9 * composite)


MISSING = {
    "lbm": "harmonizer lbm: expected the package lbm",
    "mv-colight": "harmonizer mv-colight: expected --checkout with the code of",
    "image-editing": "--max-cost: expected at least 0.04 US dollars, found 0.00",
    "flux": "harmonizer flux: expected --weights FOLDER or dot3d",
    "magic": "expected one of edit, flux, image-editing, lbm, mv-colight, none, reinhard, found 'magic'",
}


@pytest.mark.parametrize("name", MISSING)
def test_what_is_missing_is_one_line(name):
    with pytest.raises(ValueError, match=MISSING[name]) as error:
        make_harmonizer(named_options(OptionWords(name)))
    assert "\n" not in str(error.value)


def test_reinhard_changes_the_object_alone_and_brings_it_near_its_surroundings():
    shown = view()
    image = make_harmonizer(named_options(OptionWords("reinhard"))).harmonize(shown)
    inside = shown.mask > 0.5
    assert torch.equal(image[~inside], shown.prior[~inside])
    # the grey uniform background spans 0.3-0.5: matched log statistics put the mean within a tenth of that of 0.4
    assert (image[inside].mean(0) - 0.4).abs().max() < 0.04
    # and its deviation, 0.2/sqrt(12) = 0.058, replaces the object's of 0.26
    assert image[inside].std(0).max() < 0.09
    nothing = HarmonizerInputs(**{**shown.__dict__, "mask": torch.zeros(40, 60)})
    assert torch.equal(make_harmonizer(named_options(OptionWords("reinhard"))).harmonize(nothing), shown.prior)


def test_lbm_is_asked_and_kept_inside_the_object(monkeypatch):
    package, inference = ModuleType("lbm"), ModuleType("lbm.inference")
    package.__spec__ = sys.__spec__
    asked = []
    inference.get_model = lambda weights, **settings: asked.append((weights, settings["device"])) or "model"
    inference.evaluate = lambda model, image, steps: Image.new("RGB", (8, 8), (255, 0, 0))
    monkeypatch.setitem(sys.modules, "lbm", package)
    monkeypatch.setitem(sys.modules, "lbm.inference", inference)
    image = make_harmonizer(named_options(OptionWords("lbm"))).harmonize(view())
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
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    Service.asked, Service.status = [], 200
    yield f"http://127.0.0.1:{server.server_port}/edit"
    server.shutdown()
    thread.join()
    server.server_close()


def test_an_editing_service_is_sent_the_paper_s_prompt_composite_and_mask(service, monkeypatch):
    said, options = [], ImageEditingOptions(weights=service, max_cost=0.2)
    monkeypatch.setenv(KEY_VARIABLE, "secret")
    image = make_harmonizer(options, HarmonizerContext(views=3, say=said.append)).harmonize(view())
    assert (image - view().composite).abs().max() < 1 / 255  # the stand-in returns the composite, in 8 bits
    key, body = Service.asked[0]
    text, _, mask = body["contents"][0]["parts"]
    assert key == "secret"
    assert text["text"] == PROMPT
    shown = np.array(Image.open(io.BytesIO(base64.b64decode(mask["inline_data"]["data"]))))
    assert set(np.unique(shown)) == {0, 255}
    assert "3 views" in said[0]
    assert "0.12 US dollars" in said[0]


def test_an_editing_service_that_fails_or_has_no_key_is_one_line(service, monkeypatch):
    options = ImageEditingOptions(weights=service, max_cost=1.0)
    with pytest.raises(ValueError, match="expected a key in SPLATGRAFT_IMAGE_EDITING_KEY, found none"):
        make_harmonizer(options)
    with pytest.raises(ValueError, match="expected --weights https://"):
        make_harmonizer(ImageEditingOptions(weights="ftp://x", max_cost=1.0))
    monkeypatch.setenv(KEY_VARIABLE, "secret")
    Service.status = 429
    with pytest.raises(ValueError, match=r"expected an answer, found status 429: .*quota"):
        make_harmonizer(options).harmonize(view())


@pytest.fixture
def other_python(tmp_path):
    """Return an interpreter that runs `program` instead of the adaptor's, as PYTHON - MODEL_FOLDER INPUT OUTPUT."""
    python, file = tmp_path / "python", tmp_path / "program.py"

    def make(program):
        file.write_text(program)
        python.write_text(f'#!/bin/sh\nexec {sys.executable} {file} "$@"\n')
        python.chmod(0o755)
        return MVCoLight(tmp_path, tmp_path, python)

    return make


def test_mv_colight_runs_in_its_own_python_and_its_change_is_laid_on_the_composite(other_python, tmp_path):
    # each square is darkened by a factor of its own; between them the factor changes smoothly
    program = (
        "import sys, numpy as np; given = np.load(sys.argv[3])[:, :3]; "
        "np.save(sys.argv[4], given * np.linspace(1, 0.5, len(given))[:, None, None, None].astype('float32'))"
    )
    flat = torch.full((64, 96, 3), 0.5)
    shown = HarmonizerInputs(flat, flat, torch.ones(64, 96), torch.ones(64, 96), flat)
    row = other_python(program).harmonize(shown)[32, :, 0]
    assert float(row[0]) == pytest.approx(0.5, abs=0.01)
    assert float(row[-1]) < 0.3
    # the change of a factor of two is spread over half a square: 32 of these pixels
    assert float((row[1:] - row[:-1]).abs().max()) < 0.03
    (tmp_path / "python").write_text("#!/bin/sh\necho 'ModuleNotFoundError: mmengine' >&2\nexit 1\n")
    with pytest.raises(ValueError, match="expected MV-CoLight to make a picture, found ModuleNotFoundError: mmengine"):
        MVCoLight(tmp_path, tmp_path, tmp_path / "python").harmonize(view())


def test_mv_colight_sees_squares_whose_shorter_side_has_its_size_and_nothing_is_squeezed():
    def shown(h, w):
        y, x = torch.meshgrid(torch.arange(float(h)), torch.arange(float(w)), indexing="ij")
        disc = ((x - w / 2) ** 2 + (y - h / 2) ** 2 < (h / 4) ** 2).float()
        flat = disc[..., None].expand(-1, -1, 3)
        return HarmonizerInputs(flat, flat, disc, 1 + disc, flat)

    # like rescale_and_crop of its data sets: the shorter side to 256, the aspect kept
    for h, w, count in ((496, 704, 2), (256, 256, 1), (300, 1000, 4), (704, 496, 2)):
        squares = network_input(shown(h, w))
        assert squares.shape == (count, 7, 256, 256)
    disc = network_input(shown(496, 704))[0, 0] > 0.5
    rows, columns = disc.any(1).sum(), disc.any(0).sum()
    # a disc of a quarter of the height is as wide as high, if all of it is in the first square
    assert abs(int(rows) - 128) <= 2
    assert abs(int(columns) - 128) <= 2


def test_a_method_on_the_command_line_has_options_of_its_own():
    text = "off+image-editing/l1-dssim@linear:max-cost=2,weights=https://host:80/a@b/c"
    method = Method.parse(text)
    assert (method.harmonizer, method.loss, method.schedule) == ("image-editing", "l1-dssim", "linear")
    made = named_options(OptionWords(method.harmonizer, method.options), weights="another")
    assert made == ImageEditingOptions(weights="https://host:80/a@b/c", max_cost=2.0)
    # --harmonizer-weights is the default of a method that names none
    assert named_options(OptionWords("flux"), weights="mine").weights == "mine"
    assert named_options(OptionWords.parse("mv-colight:checkout=/a,weights=/b")).checkout == Path("/a")
    other = Method.parse(text.replace("2", "3"))
    assert (
        len({method.folder_name, other.folder_name, Method.parse("off+image-editing/l1-dssim@linear").folder_name}) == 3
    )
    assert "/" not in method.folder_name
    for wrong, line in (
        ("lbm:cost=3", "--methods lbm: expected keys among weights; found cost"),
        ("image-editing:max_cost=much", "--methods image-editing max_cost: expected float, found 'much'"),
        ("lbm:weights", "--methods: expected NAME:KEY=VALUE,KEY=VALUE, found lbm:weights"),
    ):
        with pytest.raises(ValueError, match=re.escape(line)):
            named_options(OptionWords.parse(wrong))
    with pytest.raises(ValueError, match="expected a harmonizer where options are given, found transfer:weights=a"):
        Method.parse("transfer:weights=a")


def test_a_sheet_compares_methods_and_pays_a_service_once(service, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(KEY_VARIABLE, "secret")
    folder = tmp_path / "truck" / "views"
    views = ViewFolder.create(folder, ring(2, size=(60, 40), focal=50.0))
    for index in range(2):
        views.write(index, replace(view(), mask=view().mask * index))
    paid = f"image-editing:max_cost=0.05,weights={service}"
    words = [
        "paper",
        "compare",
        str(folder),
        "--out",
        str(tmp_path / "out"),
        "--device",
        "cpu",
        "--methods",
        "reinhard",
        paid,
    ]
    assert main(words) == 0
    assert len(Service.asked) == 1
    sheet = read_rgb(tmp_path / "out" / "sheet.png")
    # four pictures of 60x40 at a height of 300, and gaps
    assert sheet.shape[0] == 304
    assert 4 * 450 <= sheet.shape[1] < 4 * 460
    wanted = make_harmonizer(named_options(OptionWords("reinhard"))).harmonize(views.read(1))
    made = read_rgb(next((tmp_path / "out").glob("*truck/reinhard/images/view.png")))
    assert (made - wanted).abs().max() < 1 / 255
    assert main([*words, "lbm"]) == 1
    assert len(Service.asked) == 1
    assert "lbm: harmonizer lbm: expected the package lbm" in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--view", "seven"]) == 2
    assert "expected the view seven, found" in capsys.readouterr().err
