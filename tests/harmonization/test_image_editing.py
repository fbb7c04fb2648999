"""The harmoniser `edit` with a real pipeline of diffusers on tiny weights, and `harmonize photo`."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

from test_flux import view
from tiny_models import CHANNELS, flux_folder, kontext_folder, quiet

from splatgraft.cli import main
from splatgraft.core.images import read_rgb, write_image
from splatgraft.harmonization import EditOptions, HarmonizerContext, make_harmonizer
from splatgraft.harmonization.image_editing import PROMPT, near_object

pytestmark = list(quiet)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return kontext_folder(tmp_path_factory.mktemp("kontext") / "model")


def editor(folder, said=None, **other):
    options = EditOptions(model=str(folder), sampling_steps=2, **other)
    return make_harmonizer(options, HarmonizerContext(say=(said if said is not None else []).append))


@pytest.mark.long
def test_the_pipeline_edits_near_the_object_alone_with_one_seed_for_all_views(folder):
    said, shown = [], view(64, 96)
    shown.mask.zero_()
    shown.mask[10:20, 10:20] = 1
    harmonizer = editor(folder, said)
    made = harmonizer.harmonize(shown)
    assert said[-1].startswith("edit: FluxKontextPipeline of ")
    assert said[-1].endswith("given the composite alone")
    assert harmonizer.settings["prompt"] == PROMPT
    # the object is 10 pixels wide: pixels more than 15 away are the composite's
    far = torch.zeros(64, 96, dtype=torch.bool)
    far[40:] = far[:, 40:] = True
    assert torch.equal(made[far], shown.composite[far])
    assert (made - shown.composite)[10:20, 10:20].abs().mean() > 0.02
    assert torch.equal(made, harmonizer.harmonize(shown))
    assert not torch.equal(made, editor(folder, seed=1).harmonize(shown))
    assert not torch.equal(made, editor(folder, prompt="a b").harmonize(shown))


def test_the_neighbourhood_is_as_wide_as_the_object_and_fades_out():
    mask = torch.zeros(100, 100)
    mask[40:50, 40:50] = 1
    near = near_object(mask)
    assert float(near[40:50, 40:50].min()) == 1
    assert float(near[45, 58]) == 1
    assert 0 < float(near[45, 62]) < 1
    assert float(near[45, 70]) == 0
    assert float(near_object(torch.zeros(4, 4)).max()) == 0


def test_what_is_no_editing_pipeline_is_one_line(folder, tmp_path):
    with pytest.raises(
        ValueError, match=r"--model .*nowhere: expected a folder or hub id of a diffusers pipeline, found"
    ):
        editor(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"--model .*image-mask: expected a folder of a diffusers pipeline, found"):
        editor(flux_folder(tmp_path / "image-mask", 12 * CHANNELS))
    with pytest.raises(ValueError, match="harmonizer edit: expected --model FOLDER or a hub id"):
        make_harmonizer("edit")


@pytest.mark.long
def test_one_photo_is_harmonised_by_its_mask(folder, tmp_path, capsys):
    shown = view(37, 50)
    mask = tmp_path / "mask.png"
    write_image(tmp_path / "composite.png", shown.composite)
    write_image(mask, shown.mask)
    flux = flux_folder(tmp_path / "image-mask", 12 * CHANNELS)
    words = ["harmonize", "photo", str(tmp_path / "composite.png"), str(mask), "--out", str(tmp_path / "out.png")]
    assert main([*words, "--weights", str(flux)]) == 0
    made = read_rgb(tmp_path / "out.png")
    assert made.shape == (37, 50, 3)
    # by the same network as a view of a scene
    from splatgraft.harmonization import FluxOptions

    read = replace(shown, composite=read_rgb(tmp_path / "composite.png"))
    wanted = make_harmonizer(FluxOptions(weights=str(flux))).harmonize(read)
    assert (made - wanted).abs().max() <= 0.5 / 255 + 1e-6
    assert main([*words, "edit", "--model", str(folder), "--sampling-steps", "1"]) == 0
    assert not torch.equal(read_rgb(tmp_path / "out.png"), made)
    capsys.readouterr()
    # an impossible input gives one line, and the earlier picture stays
    before = (tmp_path / "out.png").read_bytes()
    write_image(mask, shown.mask[:20])
    assert main([*words, "--weights", str(flux)]) == 2
    assert "mask.png: expected 50x37 pixels as" in capsys.readouterr().err
    write_image(mask, torch.zeros(37, 50))
    assert main([*words, "--weights", str(flux)]) == 2
    assert "expected a mask that is white where the object is, found a black one" in capsys.readouterr().err
    write_image(mask, shown.mask)
    assert main([*words, "--weights", str(flux_folder(tmp_path / "image-background", 12 * CHANNELS))]) == 2
    assert "--background: expected the picture without the object for this model" in capsys.readouterr().err
    assert main(words) == 2
    assert "harmonizer flux: expected --weights FOLDER or dot3d" in capsys.readouterr().err
    assert (tmp_path / "out.png").read_bytes() == before
