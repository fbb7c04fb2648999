"""The pictures that a `PictureRequest` asks for; those of the last request of each kind are kept."""

import numpy as np
from torch import Tensor

from splatgraft.editor.page.picture_request import SOURCE_KINDS, PictureRequest, pose_of
from splatgraft.editor.previews.preview import Picture, PictureKind
from splatgraft.runtime.memo import Memo


class RequestPictures:
    """Draws the two pictures of a request, and remembers the last of each kind."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._pictures = Memo()

    def forget(self) -> None:
        """Draw all anew from now on, as for another project."""
        self._pictures = Memo()

    def both(self, request: PictureRequest, problems: list[str]) -> tuple[Picture, Picture]:
        """Both pictures; one alone is drawn where the other one is not seen.

        Args:
            request: What to draw.
            problems: What could not be drawn is appended, one line each; that picture is grey.

        Returns:
            The left and the right picture.
        """
        if request.split <= 0 or request.left == request.right:
            right = self._picture(request.right, request, problems)
            return right, right
        left = self._picture(request.left, request, problems)
        return (left, left) if request.split >= 1 else (left, self._picture(request.right, request, problems))

    def _picture(self, kind: PictureKind, request: PictureRequest, problems: list[str]) -> Picture:
        selection = request.session.selection() if _is_source(request) else None
        try:
            return self._pictures.get(kind, picture_key(request), lambda: _rendered(kind, request, selection))
        except ValueError as error:
            problems.append(str(error))
            return Picture(np.full((request.camera.height, request.camera.width, 3), 48, np.uint8))


def picture_key(request: PictureRequest) -> tuple[object, ...]:
    """What the pictures of a request depend on, other than their kind; requests with equal keys give equal pictures."""
    state, result = request.state, request.session.files.result
    stamp = result.stat().st_mtime_ns if result.is_file() else 0
    relighting = request.session.relighting
    found = (request.draft and relighting.is_relit(state), request.draft and relighting.is_refined(state))
    drawn = (request.draft, *found, request.budget or 0, request.is_sample)
    selection = request.session.selection() if _is_source(request) else None
    return (pose_of(request.camera), *drawn, stamp, state.objects, state.erased, state.light, state.weights, selection)


def _is_source(request: PictureRequest) -> bool:
    return request.left in SOURCE_KINDS and not request.is_sample


def _rendered(kind: PictureKind, request: PictureRequest, selection: Tensor | None) -> Picture:
    preview = request.session.preview
    if request.is_sample:
        scene = request.session.scenes.files.source_scene if kind in SOURCE_KINDS else None
        return preview.sampled_view(request.state, request.camera, source=scene)
    if kind in SOURCE_KINDS:
        return Picture(preview.source_picture(selection if kind == "Object alone" else None, request.camera))
    return preview.view(kind, request.state, request.camera, draft=request.draft, budget=request.budget)
