"""Models of one database that share photos, put into one frame."""

from typing import Any

_SHARED_PHOTOS = 3
"""Photos that two models must share: the fewest that fix a similarity transform by the places of cameras."""


def joined(models: list[Any]) -> Any | None:
    """The largest of `models` with the photos of the others that fit it; None where none does.

    The transform is the one in which most points of shared photos are seen where both models say
    (COLMAP's model_aligner). The points are those of the largest model: what was added has to be triangulated.
    """
    import pycolmap

    by_size = sorted(models, key=lambda model: -model.num_reg_images())
    if len(by_size) < 2:
        return None
    whole, added = pycolmap.Reconstruction(by_size[0]), 0
    for part in by_size[1:]:
        shared = set(whole.reg_image_ids()) & set(part.reg_image_ids())
        if len(shared) < _SHARED_PHOTOS:
            continue
        whole_from_part = pycolmap.align_reconstructions_via_reprojections(part, whole)
        if whole_from_part is None:
            continue
        moved = pycolmap.Reconstruction(part)
        moved.transform(whole_from_part)
        for i in sorted(set(moved.reg_image_ids()) - shared):
            image = moved.images[i]
            if not whole.exists_image(i):
                continue
            frame = whole.frame(image.frame_id)
            frame.rig_from_world = moved.frame(image.frame_id).rig_from_world
            whole.register_frame(image.frame_id)
            added += 1
    return whole if added else None
