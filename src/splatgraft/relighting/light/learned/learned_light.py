"""The estimated light at a place after the learned correction."""

import math

import torch

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.estimate import EstimatedLight, NoLight, fit_light
from splatgraft.relighting.light.learned.ensemble import LightEnsemble
from splatgraft.relighting.light.learned.network import LightCorrection
from splatgraft.relighting.light.place_description import (
    cell_directions,
    cell_of,
    cell_solid_angles,
    describe_place,
    upright_from_world,
)
from splatgraft.relighting.light.radiance_correction import RadianceCorrection, RatioShares
from splatgraft.relighting.light.surroundings import DIRECTIONS


def fit_learned_light(
    scene: Gaussians,
    place: BoundingSphere,
    cameras: Cameras,
    ensemble: LightEnsemble | None,
    *,
    object_gaussians: Gaussians | None = None,
) -> EstimatedLight | NoLight:
    """`fit_light`, corrected by networks where there are any.

    Args:
        scene: All Gaussians, without the object.
        place: The object's bounding sphere.
        cameras: Of the scene's capture.
        ensemble: The networks; None leaves the estimate as it is.
        object_gaussians: The object itself, if it stands there.
    """
    found = fit_light(scene, place, cameras, object_gaussians=object_gaussians)
    if ensemble is None or isinstance(found, NoLight):
        return found
    correction, distance = ensemble.correct(describe_place(found))
    change = radiance_correction(correction, found, shares=ensemble.shares, distance=distance)
    return found.corrected(change, scene, place)


def radiance_correction(
    correction: LightCorrection, found: EstimatedLight, *, shares: RatioShares, distance: float
) -> RadianceCorrection:
    """A correction of cells as one of `DIRECTIONS`, in the estimate's frame.

    Args:
        correction: Of one place (b = 1).
        found: The estimate at the place.
        shares: What ratios of corrected lights are worth.
        distance: Of the place from what the networks saw.
    """
    frame = upright_from_world(found.evidence.up)
    cells = cell_of(DIRECTIONS @ frame.T)
    gain = correction.gain[0].reshape(-1, 3)[cells].exp2()
    # the power of a cell goes to the direction nearest to it: there are fewer directions than cells
    power = (correction.lamp[0].exp2() * cell_solid_angles()).reshape(-1)
    nearest = (cell_directions().reshape(-1, 3) @ frame @ DIRECTIONS.T).argmax(1)
    missed = torch.zeros(len(DIRECTIONS)).index_add_(0, nearest, power) * len(DIRECTIONS) / (4 * math.pi)
    level_sd, _, tint_sd = correction.log_sd[0].exp2().tolist()
    return RadianceCorrection(gain, missed, level_sd=level_sd, tint_sd=tint_sd, shares=shares, distance=distance)
