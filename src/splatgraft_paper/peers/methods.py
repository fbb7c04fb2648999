"""Peer methods of the benchmark by name, among them LBM and the colour transfer of Reinhard et al."""

import hashlib
import tomllib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.harmonization import HARMONIZERS, HarmonizerContext, HarmonizerOptions
from splatgraft.harmonization.interface import Harmonizer, HarmonizerInputs
from splatgraft.runtime.hub import REPOSITORIES
from splatgraft.runtime.settings import Table, field_types, from_table
from splatgraft_paper.peers.image_editing import ImageEditingOptions
from splatgraft_paper.peers.mv_colight import MVCoLightOptions

_LMS_FROM_RGB = torch.tensor([[0.3811, 0.5783, 0.0402], [0.1967, 0.7244, 0.0782], [0.0241, 0.1288, 0.8444]])
_LAB_FROM_LOG_LMS = torch.diag(torch.tensor([3.0, 6.0, 2.0]).rsqrt()) @ torch.tensor(
    [[1.0, 1, 1], [1, 1, -2], [1, -1, 0]]
)
_DARKEST = 3e-4  # minimum linear light, 1/255 in sRGB; below, the logarithm amplifies quantisation
_FLAT_DEVIATION = 1e-4  # in l-alpha-beta; an object's channel with a smaller deviation is shifted but not scaled


@dataclass(frozen=True)
class ReinhardOptions:
    """Match the object's colour statistics to its surroundings (Reinhard et al. 2001); a baseline."""

    name: ClassVar[str] = "reinhard"

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Return the harmoniser, which has no weights."""
        return Reinhard()


class Reinhard:
    """Matching of mean and deviation per channel in l-alpha-beta to those in a ring around the object; no shadow."""

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Shift the object's colours in the prior; return it unchanged if object or ring has fewer than two pixels."""
        inside = view.mask > 0.5
        around = _ring(inside)
        if int(inside.sum()) < 2 or int(around.sum()) < 2:
            return view.prior
        lab = _lab_from_srgb(view.prior)
        source, surroundings = lab[inside], _lab_from_srgb(view.background)[around]
        flat = source.std(0) <= _FLAT_DEVIATION
        scale = torch.where(flat, 1.0, surroundings.std(0) / source.std(0).clamp_min(_FLAT_DEVIATION))
        matched = _srgb_from_lab((lab - source.mean(0)) * scale + surroundings.mean(0)).clamp(0, 1)
        return torch.lerp(view.prior, matched, view.mask[..., None].clamp(0, 1))


def _ring(inside: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Mask the pixels around the object; the ring is half as wide as the root of the object's area."""
    width = max(3, round(float(inside.sum()) ** 0.5 * 0.5))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    dilated = torch.from_numpy(cv2.dilate(inside.numpy().astype(np.uint8), kernel)) > 0
    return dilated & ~inside


def _lab_from_srgb(image: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = linear_from_srgb(image).clamp_min(_DARKEST) @ _LMS_FROM_RGB.T
    return lms.log10() @ _LAB_FROM_LOG_LMS.T


def _srgb_from_lab(lab: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = 10 ** (lab @ torch.linalg.inv(_LAB_FROM_LOG_LMS).T)
    return srgb_from_linear(lms @ torch.linalg.inv(_LMS_FROM_RGB).T)


@dataclass(frozen=True)
class LbmOptions:
    """LBM relighting (Chadebec et al. 2025), run in your own installation of its package (licence CC BY-NC)."""

    name: ClassVar[str] = "lbm"

    weights: str = REPOSITORIES["lbm"]
    """Folder or hub id of the weights."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Load the network."""
        if find_spec("lbm") is None:
            raise ValueError(
                "harmonizer lbm: expected the package lbm (pip install git+https://github.com/gojasper/LBM, licence "
                "CC BY-NC 4.0), found none"
            )
        from lbm.inference import evaluate, get_model  # pyright: ignore

        context.say(f"lbm: {self.weights}, licence CC BY-NC 4.0")
        return Lbm(get_model(self.weights, torch_dtype=torch.bfloat16, device=str(context.device)), evaluate)


@dataclass(frozen=True)
class Lbm:
    """Latent bridge matching (LBM), one step from the composite; untested with the real package and weights."""

    model: Any
    evaluate: Any
    """Function `lbm.inference.evaluate`."""

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Relight the composite; as in the authors' code, pixels outside the object keep their colours."""
        given = Image.fromarray((view.composite * 255).round().to(torch.uint8).numpy())
        made = self.evaluate(self.model, given, 1).convert("RGB").resize(given.size, Image.Resampling.BICUBIC)
        image = torch.from_numpy(np.array(made)).float() / 255
        return torch.lerp(view.composite, image, view.mask[..., None].clamp(0, 1))


PEERS = {kind.name: kind for kind in (ReinhardOptions, LbmOptions, MVCoLightOptions, ImageEditingOptions)}
"""Options by name of the method."""


@dataclass(frozen=True)
class OptionWords:
    """A method with options of its own, parsed from NAME:KEY=VALUE,KEY=VALUE."""

    name: str
    options: tuple[tuple[str, str], ...] = ()

    @staticmethod
    def parse(text: str) -> "OptionWords":
        """Parse the name and the options; values may hold any character but a comma."""
        name, _, rest = text.partition(":")
        pairs = [part.partition("=") for part in rest.split(",")] if rest else []
        if not name or not all(key and found for key, found, _ in pairs):
            raise ValueError(f"--methods: expected NAME:KEY=VALUE,KEY=VALUE, found {text}")
        return OptionWords(name, tuple((key.replace("-", "_"), value) for key, _, value in pairs))

    @property
    def folder_name(self) -> str:
        """Name of a folder, which differs for other options."""
        plain = self.name.replace("/", "-")
        return f"{plain}-{hashlib.sha256(repr(self.options).encode()).hexdigest()[:8]}" if self.options else plain


def named_options(words: OptionWords, *, weights: str | None = None) -> HarmonizerOptions:
    """Return the options of a method of `HARMONIZERS` or `PEERS`; `weights` is the default of its weights, if any."""
    known = {**HARMONIZERS, **PEERS}
    if words.name not in known:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted(known))}, found {words.name!r}")
    kind = known[words.name]
    given: dict[str, Any] = {key: _value(text) for key, text in words.options}
    if weights is not None and "weights" in field_types(kind):
        given = {"weights": weights, **given}
    return from_table(kind, Table(given, f"--methods {words.name}", Path()), {})


def _value(text: str) -> Any:
    """Read a number or a truth value as in TOML; anything else is text."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text
