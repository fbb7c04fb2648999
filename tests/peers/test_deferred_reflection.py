"""3DGS-DR on a mirror ball in closed form: its environment, and its picture under another one."""

import pytest
import torch
from shapes import ring, surfels

from splatgraft.core.directions import even_directions
from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.rendering import render
from splatgraft_paper.benchmark.true_light import panorama_pixels, sample_panorama
from splatgraft_paper.peers.deferred_reflection import (
    FitOptions,
    ReflectiveScene,
    fit_reflections,
    insert,
    pixel_rays,
)

RADIUS = 0.5


def sky(directions):
    """Return an environment with more detail than the colours of a Gaussian can follow, sRGB."""
    x, y, z = directions.unbind(-1)
    return 0.5 + 0.4 * torch.stack([(3 * z).sin(), (3 * x + z).cos(), (3 * y).sin()], -1)


def other_sky(directions):
    return sky(-directions).flip(-1)


def mirror(camera, environment):
    """Return the picture of a mirror ball at the origin before black, and its mask; rays meet it in closed form."""
    rays, eye = pixel_rays(camera), camera.centers[0]
    along = -(rays @ eye)
    square = along**2 - (eye @ eye - RADIUS**2)
    hit = square > 0
    normal = (eye + rays * (along - square.clamp_min(0).sqrt())[..., None]) / RADIUS
    reflected = rays - 2 * (rays * normal).sum(-1, keepdim=True) * normal
    return torch.where(hit[..., None], environment(reflected), 0.0), hit


def panorama_of(environment, rows=32):
    return environment(panorama_pixels(torch.zeros(rows, 2 * rows, 3))[0])


def ball(count=1500):
    normals = even_directions(count)
    return surfels(RADIUS * normals, normals, width=RADIUS * 2.2 / count**0.5, srgb=(0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    cameras = ring(48, size=(64, 64), focal=150.0)
    folder = tmp_path_factory.mktemp("mirror")
    paths = []
    for index in range(len(cameras)):
        paths.append(folder / f"{index:02d}.png")
        write_image(paths[-1], mirror(cameras[index], sky)[0])
    photos = PosedImages(tuple(paths), cameras, torch.zeros(0, 3), torch.zeros(0, 3))
    chosen = torch.arange(48) % 6 > 0
    return cameras, fit_reflections(ball(), photos.select(chosen), FitOptions(steps=1000, panorama=(32, 64)))


def test_a_panorama_is_what_it_was_made_of_and_closes():
    panorama, directions = panorama_of(sky, 64), even_directions(500)
    # half a pixel of 64 rows
    assert (sample_panorama(panorama, directions) - sky(directions)).abs().max() < 0.03
    seam = torch.tensor([[-1.0, 1e-4, 0.2], [-1.0, -1e-4, 0.2]])
    left, right = sample_panorama(panorama, torch.nn.functional.normalize(seam, dim=1))
    assert (left - right).abs().max() < 1e-3


def test_the_true_map_on_a_mirror_gives_the_true_picture():
    camera = ring(12, size=(64, 64), focal=150.0)[0]
    scene = ReflectiveScene(ball(6000), torch.ones(6000), panorama_of(sky, 64))
    truth, hit = mirror(camera, sky)
    inside = torch.nn.functional.avg_pool2d(hit.float()[None, None], 5, 1, 2)[0, 0] == 1
    assert float(psnr(scene.picture(camera), truth, inside)) > 25


@pytest.mark.long
def test_a_mirror_is_found_and_held_out_views_show_it(fitted):
    cameras, scene = fitted
    camera = cameras[0]
    truth, hit = mirror(camera, sky)
    inside = torch.nn.functional.avg_pool2d(hit.float()[None, None], 5, 1, 2)[0, 0] == 1
    drawn = render(scene.gaussians, camera, features=scene.strength[:, None])
    # it starts at a thousandth
    assert float(drawn.features[0, ..., 0][inside].median()) > 0.5
    # an even ball of the mean colour, like the start of a scene without reflections
    flat = torch.full_like(truth, float(truth[hit].mean()))
    assert float(psnr(scene.picture(camera).detach(), truth, inside)) > float(psnr(flat, truth, inside)) + 8


@pytest.mark.long
def test_inserted_it_shows_the_environment_of_its_new_place(fitted):
    cameras, scene = fitted
    camera = cameras[0]
    nothing = ReflectiveScene(
        ball(1500).select(torch.zeros(1500, dtype=torch.bool)), torch.zeros(0), panorama_of(other_sky)
    )
    truth, hit = mirror(camera, other_sky)
    inside = torch.nn.functional.avg_pool2d(hit.float()[None, None], 5, 1, 2)[0, 0] == 1
    moved = insert(nothing, [scene]).picture(camera)
    assert float(psnr(moved, truth, inside)) > float(psnr(scene.picture(camera), truth, inside)) + 4
