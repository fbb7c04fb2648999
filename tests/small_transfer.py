"""A transfer without training: a ball on a plane, in two colours, in the folders of a project."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tiny_project import ball, photograph, plane

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.formats import write_gaussians
from splatgraft.project.metric_scale import MetricScale, write_scale


def darkened(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return colours times `factor`, in sRGB."""
    sh = gaussians.sh * factor
    sh[:, 0] -= (1 - factor) * 0.5 / 0.28209479
    return replace(gaussians, sh=sh)


def parts() -> dict[str, Gaussians]:
    """Return the place, the object as captured and relit, and the place with a shadow around the middle."""
    place, object_ = plane((0.6, 0.6, 0.7)).with_sh_degree(1), ball().with_sh_degree(1)
    near = (place.means[:, :2].norm(dim=1) < 0.45)[:, None, None]
    shadowed = replace(place, sh=torch.where(near, darkened(place, 0.5).sh, place.sh))
    return {"place": place, "object": object_, "relit": darkened(object_, 0.6), "shadowed": shadowed}


def write_transfer(root: Path, *, metres_per_unit: float | None = 0.5) -> Path:
    """Write the folders of a project after `relight` and `consolidate`, and return its root."""
    photograph(root / "photos", parts()["place"], None)
    project = root / "a_ball_on_a_plane"
    for name in ("target/scene", "composite", "relit", "result"):
        (project / name).mkdir(parents=True)
    (root / "photos").rename(project / "target" / "capture")
    if metres_per_unit is not None:
        write_scale(project / "target" / "capture", MetricScale(metres_per_unit, "a test"))
    p = parts()
    write_gaussians(project / "target/scene/scene.ply", p["place"])
    write_gaussians(project / "composite/scene.ply", concatenate([p["place"], p["object"]]))
    is_object = np.arange(p["place"].count + p["object"].count) >= p["place"].count
    np.save(project / "composite/is_object.npy", is_object)
    np.save(project / "relit/is_object.npy", is_object)
    for name in ("relit", "result"):
        write_gaussians(project / name / "scene.ply", concatenate([p["shadowed"], p["relit"]]))
    return project
