"""Move an object from one 3D Gaussian Splatting capture into another, with consistent light.

    import splatgraft as sg

    source, target = sg.read_capture("vase"), sg.read_capture("room")
    cut = sg.segment(sg.reconstruct(source), source)
    composite = sg.compose(sg.reconstruct(target), [cut.object], target_from_objects=[sg.Similarity.identity()])
    relit = sg.relight(composite, target.cameras, sources=[sg.SourceScene(cut.surroundings, source.cameras)])
    scene, is_object = relit.bake()
    sg.save("scene.ply", scene)

Every name is loaded when it is first used: `import splatgraft` itself imports neither torch nor numba.
"""

import ast
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatgraft.compositing.composite import Composite, PlacedObject
    from splatgraft.composition import Placed, PlaceOptions, compose, place_object
    from splatgraft.consolidation import ConsolidateOptions, consolidate
    from splatgraft.core.cameras import Cameras, look_at, pinhole
    from splatgraft.core.gaussians import Gaussians, KnownSurface
    from splatgraft.core.images import read_rgb as load_image
    from splatgraft.core.images import write_image as save_image
    from splatgraft.core.images import write_radiance as save_hdr
    from splatgraft.core.posed_images import PosedImages, held_out
    from splatgraft.core.similarity import Similarity
    from splatgraft.evaluation import Truth, evaluate, true_views
    from splatgraft.formats import SceneMetadata, read_cameras, read_capture
    from splatgraft.formats import read_gaussians as load
    from splatgraft.formats import write_gaussians as save
    from splatgraft.harmonization import (
        FluxOptions,
        Harmonizer,
        HarmonizerContext,
        HarmonizerInputs,
        harmonize,
        make_harmonizer,
        render_views,
    )
    from splatgraft.reconstruction import ReconstructOptions, reconstruct
    from splatgraft.relighting import (
        EnvironmentLight,
        LayerWeights,
        Light,
        LightSource,
        RelightOptions,
        Relit,
        SourceScene,
        light_at,
        light_from_json,
        light_to_json,
        relight,
    )
    from splatgraft.rendering import Render, RenderOptions, render
    from splatgraft.segmentation import (
        Box,
        LiftOptions,
        Segmentation,
        SelectOptions,
        SolidifyOptions,
        lift_masks,
        segment,
        select_object,
        solidify_object,
    )
    from splatgraft.workflow.run import run_project, stale_steps
    from splatgraft.workflow.transfer import Transfer, transfer

__version__ = "0.1.0"

__all__ = [
    "Box",
    "Cameras",
    "Composite",
    "ConsolidateOptions",
    "EnvironmentLight",
    "FluxOptions",
    "Gaussians",
    "Harmonizer",
    "HarmonizerContext",
    "HarmonizerInputs",
    "KnownSurface",
    "LayerWeights",
    "LiftOptions",
    "Light",
    "LightSource",
    "PlaceOptions",
    "Placed",
    "PlacedObject",
    "PosedImages",
    "ReconstructOptions",
    "RelightOptions",
    "Relit",
    "Render",
    "RenderOptions",
    "SceneMetadata",
    "Segmentation",
    "SelectOptions",
    "Similarity",
    "SolidifyOptions",
    "SourceScene",
    "Transfer",
    "Truth",
    "compose",
    "consolidate",
    "evaluate",
    "harmonize",
    "held_out",
    "lift_masks",
    "light_at",
    "light_from_json",
    "light_to_json",
    "load",
    "load_image",
    "look_at",
    "make_harmonizer",
    "pinhole",
    "place_object",
    "read_cameras",
    "read_capture",
    "reconstruct",
    "relight",
    "render",
    "render_views",
    "run_project",
    "save",
    "save_hdr",
    "save_image",
    "segment",
    "select_object",
    "solidify_object",
    "stale_steps",
    "transfer",
    "true_views",
]


@cache
def _sources() -> dict[str, tuple[str, str]]:
    """Return the module of each public name and its name there, read from the imports above, which never run."""
    block = next(node for node in ast.parse(Path(__file__).read_text("utf-8")).body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(one.module), alias.name) for one in imports for alias in one.names}


if not TYPE_CHECKING:  # otherwise a type checker would accept every unknown name

    def __getattr__(name: str) -> object:
        """Load a public name when it is first used (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module 'splatgraft' has no attribute {name!r}")
        module, own = _sources()[name]
        return getattr(import_module(module), own)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
