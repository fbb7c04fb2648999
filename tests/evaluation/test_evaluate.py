"""`evaluate`: means over views, as in the report; `true_views` pairs images by name."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_measure import example_truth, view
from tiny_project import ball

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.evaluation import evaluate, measure, true_views
from splatgraft.folders.evaluated_scenes import EvaluatedScenes, Pictures

TRUTHS = [example_truth(shadow, seed) for seed, shadow in enumerate((0.5, 0.97, 0.6))]


def noisy(seed: int) -> torch.Tensor:
    noise = 0.02 * torch.randn(80, 120, 3, generator=torch.Generator().manual_seed(seed))
    return (TRUTHS[seed].image + noise).clamp(0, 1)


def test_the_means_are_the_report_s() -> None:
    images = [noisy(i) for i in range(3)]
    found = evaluate(images, TRUTHS, backgrounds=[truth.background for truth in TRUTHS])
    views = [
        view(truth, result=image, name=str(i)) for i, (truth, image) in enumerate(zip(TRUTHS, images, strict=True))
    ]
    assert found == measure(views)["result"]
    # noise of deviation 0.02 has 34 dB
    assert found["psnr"] == pytest.approx(34.0, abs=0.2)
    # a region without pixels in any view
    truth = replace(TRUTHS[0], image=TRUTHS[0].background, mask=torch.zeros(80, 120))
    found = evaluate(images[:1], [truth], backgrounds=[truth.background])
    assert found["object_psnr"] is found["shadow_psnr"] is None
    assert found["rest_psnr"] is not None
    with pytest.raises(ValueError, match="found 1 images, 3 truths and 1 backgrounds"):
        evaluate(images[:1], TRUTHS, backgrounds=images[:1])


def capture(folder: Path, names: tuple[str, ...], levels: tuple[float, ...], masks: bool) -> PosedImages:
    folder.mkdir()
    for name, level in zip(names, levels, strict=True):
        write_image(folder / name, torch.full((4, 6, 3), level))
    cameras = replace(pinhole(torch.eye(4).repeat(len(names), 1, 1), 5.0, width=6, height=4), names=names)
    paths, none = tuple(folder / name for name in names), torch.zeros(0, 3)
    return PosedImages(paths, cameras, none, none, mask_paths=paths if masks else ())


def test_true_views_are_paired_by_name(tmp_path: Path) -> None:
    truth = capture(tmp_path / "truth", ("b.png", "a.png"), (0.2, 0.4), masks=True)
    target = capture(tmp_path / "target", ("a.jpg", "c.png", "b.jpg"), (0.6, 0.0, 0.8), masks=False)
    views = true_views(truth, target)
    # 8 bits, and JPEG of one flat colour: half a level each, and some rounding
    assert [round(float(one.image.mean()), 2) for one in views] == [0.2, 0.4]
    assert [round(float(one.background.mean()), 2) for one in views] == [0.8, 0.6]
    with pytest.raises(ValueError, match="an image of the target named b as in the truth"):
        true_views(truth, target.select(torch.tensor([True, True, False])))
    with pytest.raises(ValueError, match=r"b\.jpg: expected a mask of the object, found none"):
        true_views(target.select(torch.tensor([False, False, True])), truth)


def test_a_view_of_the_whole_object_is_shown_before_a_larger_one_that_is_cut() -> None:
    def at(name: str, left: int, size: int) -> Pictures:
        mask = torch.zeros(40, 60)
        mask[10 : 10 + size, left : left + size] = 1.0
        return Pictures(name, *(torch.zeros(40, 60, 3) for _ in range(3)), mask=mask)

    cut, whole, small, tiny = at("cut", 0, 16), at("whole", 20, 10), at("small", 20, 9), at("tiny", 20, 3)
    assert max((cut, whole, small), key=lambda p: p.prominence) is whole
    # a view that hardly shows the object is not chosen
    assert max((cut, tiny), key=lambda p: p.prominence) is cut
    # nor is one of the side that no photograph shows
    assert max((replace(whole, guessed_share=0.5), small), key=lambda p: p.prominence) is small
    # even if it is twice as large
    assert max((replace(at("large", 20, 14), guessed_share=0.4), small), key=lambda p: p.prominence) is small


def test_the_best_view_is_sought_among_all_cameras() -> None:
    object_ = ball()
    nothing = torch.zeros(object_.count, dtype=torch.bool)
    eyes = torch.tensor([[0.0, -3.0, 0.5]]).repeat(30, 1)
    # all but one look past it, so that the rim cuts it
    aims = torch.tensor([[1.1, 0.0, 0.3]]).repeat(30, 1)
    aims[17] = torch.tensor([0.0, 0.0, 0.3])
    poses = torch.cat([look_at(eye[None], aim, torch.tensor([0.0, 0, 1])) for eye, aim in zip(eyes, aims, strict=True)])
    cameras = pinhole(poses, 200.0, width=160, height=120)
    scenes = EvaluatedScenes(object_, object_, ~nothing, nothing, cameras)
    assert scenes.best_view == 17
    # a narrower cut view is not better, but a nearer one of the whole object is
    nearer = cameras.world_from_camera.clone()
    nearer[5] = look_at(torch.tensor([[0.0, -2.5, 0.5]]), torch.tensor([0.0, 0.0, 0.3]), torch.tensor([0.0, 0, 1]))[0]
    assert replace(scenes, cameras=pinhole(nearer, 200.0, width=160, height=120)).best_view == 5
