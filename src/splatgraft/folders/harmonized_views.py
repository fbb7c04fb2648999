"""Harmonisation of the views of a folder, or of every k-th of them, with one image file per finished view.

A view is finished when its image exists, so a part can be started again after a kill or by another process.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch

from splatgraft.core.images import stored_size, write_image
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import (
    BatchHarmonizer,
    Harmonized,
    HarmonizerContext,
    HarmonizerOptions,
    make_harmonizer,
)
from splatgraft.project.step import choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress, silent

_READERS, _WRITERS = 2, 2
"""Threads that decode and encode images beside the model. Set by hand: about 0.09 s a view of 704x496 in one thread."""
_WAITING_GROUPS = 2
"""Groups of finished views that may wait to be written."""
_CPU_METHODS = ("none", "reinhard", "mv-colight", "image-editing")
"""Methods that use no device of this process."""


@dataclass(frozen=True)
class Part:
    """Every `of`-th view of a folder, from `number` on."""

    views: Path
    """The folder of views."""
    method: HarmonizerOptions
    """The harmoniser's options."""
    kept: Path
    """Folder for finished images: images/ and confidence/."""
    number: int = 0
    of: int = 1
    device: str = "auto"
    """As in `choose_device`: auto, cpu or cuda."""
    assigned_device: str | None = None
    """The device that a launcher assigned to this process; replaces `device`."""
    key: str | None = None
    """Of a service."""

    def missing(self, views: ViewFolder) -> list[int]:
        """Indices of the part's views that are not finished."""
        done = finished(self.kept, views)
        return [i for i in range(self.number, len(views), self.of) if i not in done]


def picture_folders(kept: Path) -> None:
    """Make the folders for finished images."""
    for name in ("images", "confidence"):
        (kept / name).mkdir(exist_ok=True)


def finished(kept: Path, views: ViewFolder) -> set[int]:
    """Indices of the views whose image exists."""
    return {i for i, stem in enumerate(views.stems) if (kept / "images" / f"{stem}.png").is_file()}


def harmonize_part(part: Part, say: Callable[[str], None] = lambda sentence: None, progress: Progress = silent) -> None:
    """Harmonise the views of the part that are not finished.

    Raises:
        ValueError: The method's weights or packages are missing, or a view is damaged.
    """
    views = ViewFolder.open(part.views)
    missing = part.missing(views)
    if not missing:
        return
    harmonizer = make_harmonizer(part.method, _context(part, views, missing, say))
    at_once = harmonizer.views_at_once if isinstance(harmonizer, BatchHarmonizer) else 1
    done = len(views) - len(missing) if part.of == 1 else 0
    groups = _groups(views, missing, at_once)
    # files are decoded and encoded beside the model: it waits for the first group alone, and for writing at the end
    with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(_WRITERS) as writers:
        ahead = [readers.submit(views.read, i) for i in groups[0]]
        written: deque[Future[None]] = deque()
        for indices, following in zip(groups, [*groups[1:], []], strict=True):
            now, ahead = [reading.result() for reading in ahead], [readers.submit(views.read, i) for i in following]
            if isinstance(harmonizer, BatchHarmonizer):
                results = harmonizer.harmonize_all(now)
            else:
                results = [harmonizer.harmonize(view) for view in now]
            for index, result in zip(indices, results, strict=True):
                written.append(writers.submit(_write, part.kept, views.stems[index], result))
            while len(written) > _WAITING_GROUPS * at_once:
                written.popleft().result()
            done += len(indices)
            progress(done, len(views), views.stems[indices[-1]])
        for writing in written:
            writing.result()


def _context(part: Part, views: ViewFolder, missing: list[int], say: Callable[[str], None]) -> HarmonizerContext:
    device = part.assigned_device
    if device is None:
        device = "cpu" if part.method.name in _CPU_METHODS else choose_device(part.device, Console()).type
    width, height = stored_size(views.path("composite", missing[0]))
    return HarmonizerContext(
        device=torch.device(device), views=len(missing), pixels=width * height, key=part.key, say=say
    )


def _groups(views: ViewFolder, indices: list[int], at_once: int) -> list[list[int]]:
    """The indices in their order, in groups of views of one size."""
    groups: list[list[int]] = []
    sizes = {i: stored_size(views.path("composite", i)) for i in indices} if at_once > 1 else {}
    for index in indices:
        if groups and len(groups[-1]) < at_once and sizes[groups[-1][0]] == sizes[index]:
            groups[-1].append(index)
        else:
            groups.append([index])
    return groups


def _write(kept: Path, stem: str, result: Harmonized) -> None:
    if result.confidence is not None:
        write_image(kept / "confidence" / f"{stem}.png", result.confidence)
    write_image(kept / "images" / f"{stem}.png", result.image)  # last: the view counts as finished
