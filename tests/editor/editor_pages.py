"""A project of two tiny scenes, and the real page on it, with the messages that a browser would send."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tiny_project import ball, plane
from viser import GuiEvent

from splatgraft.cli import main
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.editor.page.opening import Opening
from splatgraft.editor.page.page import Page
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.project import Project
from splatgraft.formats import write_gaussians
from splatgraft.project.toml_edit import with_keys

AROUND_THE_BALL = [-0.35, -0.35, 0.03, 0.35, 0.35, 0.65]
TOKEN = "secret"


def scene_project(root: Path, *, suffix: str = ".ply", target: Gaussians | None = None, **segment: object) -> Path:
    """Write two scene files and a project of them, and return project.toml. The target is a plane by default."""
    scenes = [concatenate([plane((0.3, 0.5, 0.3)), ball()]), plane((0.5, 0.45, 0.6)) if target is None else target]
    paths = [root / f"{name}{suffix}" for name in ("source", "target")]
    for path, scene in zip(paths, scenes, strict=True):
        write_gaussians(path, scene)
    project = root / "project" / "project.toml"
    assert main(["init", str(project.parent), "--source", str(paths[0]), "--target", str(paths[1])]) == 0
    box = {"box": AROUND_THE_BALL, "mask_source": "box"}
    text = with_keys(project.read_text(), "segment", {"keep": "all", "solidify": 4, **box, **segment})
    for side in ("source", "target"):
        text = with_keys(text, side, {"views": 8, "picture_width": 160})
    text = with_keys(text, "compose", {"point": [0.0, 0.0, 0.5], "scale": 0.8})
    # a third of the time of a light transfer
    text = with_keys(text, "relight", {"most_added": 0.0})
    project.write_text(with_keys(text, "consolidate", {"passes": 1}))
    return project


@contextmanager
def served() -> Iterator[GuardedServer]:
    """Return a server without a page, at a free port."""
    guarded = GuardedServer(TOKEN, host="127.0.0.1", port=0)
    try:
        yield guarded
    finally:
        guarded.close()


@contextmanager
def opened_page(project: Path, *, opening: bool = False) -> Iterator[Page]:
    """Return the page on a project, which need not exist."""
    with served() as guarded:
        shown = Opening(guarded.viser, project, project.parent) if opening else None
        page = Page(guarded, Project(project), budget=1000, opening=shown)
        try:
            yield page
        finally:
            page.close()


def cloud(count: int, seed: int) -> Gaussians:
    """Return random Gaussians of SH degree 1."""
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(count, 3, generator=generator),
        log_scales=-3 + torch.rand(count, 3, generator=generator),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=torch.randn(count, generator=generator),
        sh=torch.rand(count, 4, 3, generator=generator),
    )


def arrives(handle: Any, value: Any) -> None:
    """Convert a value from a browser, as viser does first."""
    handle._impl.value = value


def is_handled(handle: Any) -> None:
    """Handle a value, as viser does next in another thread."""
    for callback in handle._impl.update_cb:
        callback(GuiEvent(client=None, client_id=0, target=handle))  # pyright: ignore[reportArgumentType]


def sends(handle: Any, value: Any) -> None:
    """Send a value like a browser, and handle it."""
    arrives(handle, value)
    is_handled(handle)
