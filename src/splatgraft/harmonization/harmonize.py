"""Renders the views of a composite, and harmonises them one by one with one method."""

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.harmonization.interface import Harmonizer, HarmonizerInputs
from splatgraft.harmonization.methods import make_harmonizer
from splatgraft.rendering import RenderOptions, render
from splatgraft.rendering.interface import Output
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import Progress, silent

_OUTPUTS: frozenset[Output] = frozenset({"color", "depth"})


def render_views(
    composite: Gaussians,
    is_object: Bool[Tensor, "n"],
    cameras: Cameras,
    *,
    prior: Gaussians | None = None,
    options: RenderOptions = RenderOptions(),
) -> LazySequence[HarmonizerInputs]:
    """Render the images that a harmoniser takes, for every view of a composite.

    Args:
        composite: n Gaussians, the object as it was captured: the first result of `Composite.bake`.
        is_object: Whether each of them belongs to an object: the second result of `Composite.bake`.
        cameras: v cameras of the target; sizes may differ.
        prior: The scene after light transfer, as `Relit.bake` gives it; the composite itself by default.
        options: Options of the renderer.

    Returns:
        The images of each camera, on the CPU. A view is rendered each time it is read, so that memory holds one view.

    Raises:
        ValueError: `is_object` has another length than `composite`.
    """
    if len(is_object) != composite.count:
        expected = f"one flag for each of {composite.count} Gaussians"
        raise ValueError(f"is_object: expected {expected}, found {len(is_object)}")
    background, coverage = composite.select(~is_object), is_object[:, None].float()

    def draw(scene: Gaussians, camera: Cameras) -> Tensor:
        return render(scene, camera, options=options).color[0].cpu().clamp(0, 1)

    def view(index: int) -> HarmonizerInputs:
        camera = cameras[index]
        full = render(composite, camera, outputs=_OUTPUTS, features=coverage, options=options)
        color = full.color[0].cpu().clamp(0, 1)
        return HarmonizerInputs(
            composite=color,
            background=draw(background, camera),
            mask=full.features[0, ..., 0].cpu().clamp(0, 1),
            depth=full.depth[0].cpu(),
            prior=color if prior is None or prior is composite else draw(prior, camera),
        )

    return LazySequence(len(cameras), view)


def harmonize(
    views: Sequence[HarmonizerInputs], method: str | Harmonizer, *, progress: Progress = silent
) -> tuple[Float[Tensor, "_ _ 3"], ...]:
    """Correct the light on the object in every view, each view by itself.

    Args:
        views: v views, as `render_views` gives them; each is read once.
        method: Harmoniser made by `make_harmonizer`, or the name of a method that needs no options (`none` keeps the
            light prior).
        progress: Called after every view with views done, v, and the number of the view.

    Returns:
        One (h, w, 3) sRGB image in [0, 1] per view, as `consolidate` takes them.

    Raises:
        ValueError: There is no method of that name, or its weights or packages are missing.
    """
    harmonizer = make_harmonizer(method) if isinstance(method, str) else method
    images: list[Tensor] = []
    for number, view in enumerate(views, 1):
        images.append(harmonizer.harmonize(view))
        progress(number, len(views), f"view {number}")
    return tuple(images)
