"""Input channels of the compact network, and the application of its output to a view.

The output consists of gains, colour matrices and offsets on the composite's own pixels at full resolution, so that the
network adds no texture of its own.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.images import linear_from_srgb
from splatgraft.harmonization.interface import HarmonizerInputs

CHANNELS = 16
SH_COUNT = 9
GRID_BINS = 4
_IMAGES = ("composite", "background", "mask", "log_ratio", "depth", "normal")


# the encoding of views for the network; the weights were trained with it
_RATIO_OFFSET = 0.004  # linear light added to both sides of a ratio: 1/255 of white, below it a ratio is noise
_MAX_LOG_RATIO = 3.0  # bound of the prior's log ratio, either sign
_MAX_LOG_GAIN = 4.0  # bound of the total log gain that is applied, either sign
_MAX_LOG_DEPTH = 2.0  # bound of the relative log depth, either sign; also the value where nothing is hit
_LOG_OFFSET = 1 / 64  # linear light added before the logarithm of a colour channel
_LUMA_GAMMA = 2.2  # brightness axis of the bilateral grid: mean linear light to the power of its inverse


@dataclass(frozen=True)
class CompactInput:
    """A batch of views in linear light, channels first, all of one size."""

    composite: Float[Tensor, "b 3 h w"]
    """Linear light, before light transfer."""
    background: Float[Tensor, "b 3 h w"]
    """Linear light, without the object."""
    mask: Float[Tensor, "b 1 h w"]
    log_ratio: Float[Tensor, "b 3 h w"]
    """Log ratio of the prior over the composite, see `log_light_ratio`; 0 without a prior."""
    depth: Float[Tensor, "b 1 h w"]
    """Log of depth over the object's median depth, clamped to [-2, 2]; 2 where no surface is hit."""
    normal: Float[Tensor, "b 3 h w"]
    """Unit normal in the camera's frame (OpenCV axes); 0 where no surface is hit."""
    prior_confidence: Float[Tensor, "b"]
    """Confidence in the prior, in [0, 1]."""

    def channels(self) -> Float[Tensor, "b 16 h w"]:
        """Stack the network's input channels."""
        b, _, h, w = self.mask.shape
        prior_confidence = self.prior_confidence[:, None, None, None].expand(b, 1, h, w)
        hit = (self.normal.abs().sum(1, keepdim=True) > 0).to(self.mask)
        colors = [_log_encoded(self.composite), _log_encoded(self.background), self.log_ratio]
        return torch.cat([*colors, 2 * self.mask - 1, self.depth, hit, self.normal, prior_confidence], 1)

    def prior(self) -> Float[Tensor, "b 3 h w"]:
        """Compute the view after light transfer, linear light."""
        offset = _RATIO_OFFSET
        return ((self.composite + offset) * self.log_ratio.exp() - offset).clamp_min(0)

    def to(self, device: torch.device) -> "CompactInput":
        """Move all tensors to a device."""
        return CompactInput(**{name: getattr(self, name).to(device) for name in (*_IMAGES, "prior_confidence")})

    def resized(self, height: int, width: int) -> "CompactInput":
        """Resize all images bilinearly, with antialiasing where the size decreases."""

        def resize(x: Tensor) -> Tensor:
            return F.interpolate(x, size=(height, width), mode="bilinear", antialias=True, align_corners=False)

        images = {name: resize(getattr(self, name)) for name in _IMAGES}
        return CompactInput(**images, prior_confidence=self.prior_confidence)


@dataclass(frozen=True)
class CompactOutput:
    """The network's prediction for a batch of views, at a lower resolution."""

    object_prior_scale: Float[Tensor, "b 1 i j"]
    """Factor on the prior's log ratio on the object, as a difference from 1."""
    object_gain: Float[Tensor, "b 3 i j"]
    """Log gain on the object."""
    object_sh: Float[Tensor, "b 9 3"]
    """Log gain on the object as a function of the normal, spherical harmonics of degree 2."""
    object_grid: Float[Tensor, "b 12 l p q"]
    """Bilateral grid (Chen et al. 2007) of affine colour maps, as a difference: 3 rows of 3 factors and an offset."""
    scene_prior_scale: Float[Tensor, "b 1 i j"]
    """Factor on the prior's log ratio off the object, as a difference from 1."""
    scene_gain: Float[Tensor, "b 3 i j"]
    """Log gain off the object: shadow and bounced light."""
    scene_added: Float[Tensor, "b 3 i j"]
    """Linear light added off the object: reflections."""
    log_error: Float[Tensor, "b 1 i j"]
    """Log of the expected absolute error, sRGB."""

    def float(self) -> "CompactOutput":
        """Convert all tensors to float32."""
        return CompactOutput(**{name: tensor.float() for name, tensor in vars(self).items()})


def log_light_ratio(prior: Float[Tensor, "*n"], composite: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Compute the clamped logarithm of prior over composite, both linear light with a small offset."""
    offset, bound = _RATIO_OFFSET, _MAX_LOG_RATIO
    return ((prior + offset) / (composite + offset)).log().clamp(-bound, bound)


def apply_output(view: CompactInput, output: CompactOutput) -> Float[Tensor, "b 3 h w"]:
    """Apply the output to a view of any size; gives linear light, at least 0. An output of zeros gives the prior."""
    size = view.mask.shape[-2:]

    def up(x: Tensor) -> Tensor:
        return F.interpolate(x, size=size, mode="bilinear", align_corners=False)

    mask = view.mask
    by_normal = torch.einsum("bkhw,bkc->bchw", _harmonics(view.normal), output.object_sh)
    on_object = (1 + up(output.object_prior_scale)) * view.log_ratio + up(output.object_gain) + by_normal
    on_scene = (1 + up(output.scene_prior_scale)) * view.log_ratio + up(output.scene_gain)
    log_gain = (mask * on_object + (1 - mask) * on_scene).clamp(-_MAX_LOG_GAIN, _MAX_LOG_GAIN)
    lit = (view.composite + _RATIO_OFFSET) * log_gain.exp() - _RATIO_OFFSET
    lit = lit + mask * _affine(lit, output.object_grid) + (1 - mask) * up(output.scene_added)
    return lit.clamp_min(0)


def compact_input(inputs: HarmonizerInputs) -> CompactInput:
    """Convert one view to a batch of one in linear light."""
    composite, background, prior = [
        linear_from_srgb(image.clamp(0, 1)).permute(2, 0, 1)[None]
        for image in (inputs.composite, inputs.background, inputs.prior)
    ]
    rotation = inputs.camera_from_world
    normal = inputs.normal if rotation is None else inputs.normal @ rotation.T
    return CompactInput(
        composite=composite,
        background=background,
        mask=inputs.mask.clamp(0, 1)[None, None],
        log_ratio=log_light_ratio(prior, composite),
        depth=relative_depth(inputs.depth, inputs.mask)[None, None],
        normal=normal.permute(2, 0, 1)[None],
        prior_confidence=torch.tensor([inputs.prior_confidence]),
    )


def relative_depth(depth: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Compute the log of depth over the object's median depth, clamped to [-2, 2]; 2 where no surface is hit."""
    hit, bound = depth > 0, _MAX_LOG_DEPTH
    inside = hit & (mask > 0.5)
    known = depth[inside] if bool(inside.any()) else depth[hit]
    median = known.median() if known.numel() else depth.new_ones(())
    return torch.where(hit, (depth.clamp_min(1e-6) / median).log().clamp(-bound, bound), bound)


def _log_encoded(linear: Tensor) -> Tensor:
    """Compute the logarithm of light, scaled to about [-1, 1]."""
    return (linear + _LOG_OFFSET).log() / 2 + 1


def _harmonics(normal: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 9 h w"]:
    b, _, h, w = normal.shape
    flat = normal.permute(0, 2, 3, 1).reshape(-1, 3)
    return spherical_harmonics.basis(flat, 2).reshape(b, h, w, SH_COUNT).permute(0, 3, 1, 2)


def _affine(lit: Float[Tensor, "b 3 h w"], grid: Float[Tensor, "b 12 l p q"]) -> Float[Tensor, "b 3 h w"]:
    """Compute the change of colours by the bilateral grid, sliced by pixel position and brightness."""
    b, _, h, w = lit.shape
    luma = lit.mean(1).clamp(0, 1) ** (1 / _LUMA_GAMMA) * 2 - 1
    y = (torch.arange(h, device=lit.device) + 0.5) / h * 2 - 1
    x = (torch.arange(w, device=lit.device) + 0.5) / w * 2 - 1
    coordinates = torch.stack([x.expand(b, h, w), y[:, None].expand(b, h, w), luma], -1)[:, None]
    sliced = F.grid_sample(grid, coordinates, padding_mode="border", align_corners=False)[:, :, 0]
    rows = sliced.reshape(b, 3, 4, h, w)
    return (rows[:, :, :3] * lit[:, None]).sum(2) + rows[:, :, 3]
