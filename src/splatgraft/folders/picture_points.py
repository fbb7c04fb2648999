"""Points that a user gives by pixels of pictures: prompts, a place, the ends of a known length."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.capture import triangulate
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import stored_points, stored_size
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.rendering import surface_points


def prompts_by_view(capture: PosedImages, prompts: Mapping[str, ViewPrompt], path: Path) -> dict[int, ViewPrompt]:
    """Convert the prompts of the file `path` from pictures' names to views' indices and undistorted pixels."""
    found = {}
    for name, prompt in prompts.items():
        index = picture_called(capture.cameras.names, name, str(path))
        found[index] = in_camera_pixels(capture, index, prompt)
    return found


def picture_called(names: Sequence[str], name: str, where: str) -> int:
    """Find the picture of a name, with or without folder and suffix; `where` is the name's source, for messages."""
    paths, called = [PurePath(other) for other in names], PurePath(name)
    wanted = [i for i, other in enumerate(paths) if name in (str(other), other.name, other.stem)]
    wanted = wanted or [i for i, other in enumerate(paths) if called.stem == other.stem]
    if len(wanted) != 1:
        raise ValueError(f"{where}: expected one picture called {name}, found {len(wanted)} of {len(names)}")
    return wanted[0]


def in_camera_pixels(capture: PosedImages, index: int, prompt: ViewPrompt) -> ViewPrompt:
    """Convert a prompt from pixels of the upright picture to those of its undistorted camera."""
    camera, path = capture.cameras[index], capture.image_paths[index]
    distortion = capture.distortions[index] if capture.distortions else None
    size = distortion.size if distortion is not None else (camera.width, camera.height)
    width, height = stored_size(path, size)

    def moved(points: Tensor) -> Tensor:
        at_size = stored_points(path, points, size) * torch.tensor([size[0] / width, size[1] / height])
        return at_size if distortion is None else distortion.undistort_points(at_size, camera.intrinsics[0])

    box = prompt.box
    if box is not None:
        x0, y0, x1, y1 = box
        middle = [[(x0 + x1) / 2, y0], [(x0 + x1) / 2, y1], [x0, (y0 + y1) / 2], [x1, (y0 + y1) / 2]]
        edges = moved(torch.tensor([[x0, y0], [x1, y0], [x0, y1], [x1, y1], *middle]))
        (left, top), (right, bottom) = edges.amin(0).tolist(), edges.amax(0).tolist()
        box = (left, top, right, bottom)
    return ViewPrompt(moved(prompt.inside), moved(prompt.outside), box)


def point_in_world(text: str, capture: PosedImages, scene: Gaussians | None, *, option: str) -> Float[Tensor, "3"]:
    """Compute the point in the world that a user gives.

    Args:
        text: "X,Y,Z" in the world; "IMAGE:X,Y", a pixel whose surface point is meant; or "IMAGE:X,Y IMAGE:X,Y", one
            point in several pictures, which is triangulated.
        capture: The pictures.
        scene: Scene whose surface a single picture shows; None if there is none.
        option: Name of the option, for messages.
    """
    parts = text.split()
    if len(parts) == 1 and ":" not in text and len(numbers := _numbers(text)) == 3:
        return torch.tensor(numbers)
    named = [part.rpartition(":") for part in parts]
    if not named or not all(name and len(_numbers(pixel)) == 2 for name, _, pixel in named):
        raise ValueError(f'{option}: expected "X,Y,Z", "IMAGE:X,Y" or "IMAGE:X,Y IMAGE:X,Y", found "{text}"')
    indices = [picture_called(capture.cameras.names, name, option) for name, _, _ in named]
    clicks = [ViewPrompt(inside=torch.tensor([_numbers(pixel)])) for _, _, pixel in named]
    pixels = [in_camera_pixels(capture, i, click).inside for i, click in zip(indices, clicks, strict=True)]
    if len(set(indices)) > 1:
        return triangulate(capture.cameras[indices], torch.cat(pixels))[0]
    if scene is None:
        raise ValueError(f'{option}: expected the point in two images, or a scene (--scene), found only "{text}"')
    found = surface_points(scene, capture.cameras[indices[0]].to(scene.device), pixels[0])
    if not len(found):
        raise ValueError(f"{option}: expected a surface at {text}, found none in the scene")
    return found[0].cpu()


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        return []
