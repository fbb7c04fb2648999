"""Loads the FLUX harmoniser from a folder or the hub, in a precision that fits the memory of its device. Layout:

    transformer/config.json, diffusion_pytorch_model*.safetensors   (or these in the folder itself; also .bf16.)
    vae/  empty_prompt.safetensors  harmonizer.json                 (or beside the folder, or the base's)

harmonizer.json is written by `train flux`: {"variant": "image-mask"}. The authors' folders are named by their variant.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import torch
from safetensors import SafetensorError, safe_open

from splatgraft.harmonization.flux.baked_modulation import bake
from splatgraft.harmonization.flux.network import Autoencoder, FirstLayer, FluxNetwork, Variant, widen_layer
from splatgraft.harmonization.flux.prompt import (
    PROMPT_FILE,
    TEXT_FOLDERS,
    embed_empty_prompt,
    find_prompt,
    read_prompt,
    write_prompt,
)
from splatgraft.harmonization.flux.sampling import schnell_levels
from splatgraft.harmonization.flux.tensor_file import one_line
from splatgraft.harmonization.interface import HarmonizerContext
from splatgraft.runtime.hub import REPOSITORIES, hub_folder, hub_id

Say = Callable[[str], None]
VARIANTS: tuple[str, ...] = get_args(Variant)
INPUTS = 3
"""Number of latents that a harmoniser's first layer takes: noisy latent, composite and condition."""
DESCRIPTION_FILE = "harmonizer.json"
_PREFIX = "transformer."
BASE = REPOSITORIES["flux"]
_AUTHORS = REPOSITORIES["dot3d"]
_BYTES = {"bf16": 2.0, "fp8": 1.0, "offload": 0.1}
"""Bytes per parameter on the device, best precision first; offload holds the two blocks in use."""
_RESERVED_BYTES = 1.2e9  # estimate for the autoencoder, the CUDA context, kernels and fragmentation


def diffusers_library() -> Any:
    """Import diffusers and silence its messages: this package reports errors itself."""
    import diffusers

    diffusers.utils.logging.set_verbosity_error()
    return diffusers


def local_folder(
    weights: str, say: Say, *, parts: Sequence[str] = ("transformer",), without_weights: bool = False
) -> Path:
    """Resolve a folder, a hub id OWNER/NAME[/FOLDER] or a short name to a local folder.

    Its `parts` and vae/ are fetched once; `without_weights` only the descriptions and the prompt's embeddings.
    """
    weights = hub_id(weights)
    folder = Path(weights)
    if folder.is_dir():
        return folder
    names = weights.split("/")
    if folder.exists() or folder.is_absolute() or weights.startswith(".") or len(names) not in (2, 3) or not all(names):
        raise ValueError(
            f"{weights}: expected a folder with transformer/ or a hub id such as {_AUTHORS} (for short dot3d), found "
            f"{'a file' if folder.exists() else 'none'}"
        )
    repository, inner = "/".join(names[:2]), "".join(names[2:])
    if repository == _AUTHORS and not inner:
        inner = "image-mask"
    wanted = [f"{inner}/*", "vae/*"] if inner else [*(f"{part}/*" for part in parts), "vae/*"]
    if without_weights:
        wanted = [f"{pattern[:-1]}{name}" for pattern in wanted for name in ("*.json", PROMPT_FILE)]
    return hub_folder(repository, [*wanted, DESCRIPTION_FILE, PROMPT_FILE], say) / inner


@dataclass(frozen=True)
class FluxFolder:
    """A model folder with a FLUX transformer."""

    folder: Path
    """The model folder."""
    transformer: Path
    """Folder of the transformer's config.json and weights."""
    config: dict[str, Any]
    """Content of the transformer's config.json."""

    @staticmethod
    def open(folder: Path) -> "FluxFolder":
        """Read the transformer's config."""
        below = folder / "transformer"
        transformer = below if (below / "config.json").is_file() else folder
        config = read_config(transformer / "config.json", "FluxTransformer2DModel")
        if config.get("guidance_embeds"):
            raise ValueError(f"{transformer}: expected a network made of FLUX.1-schnell, found one with guidance (dev)")
        config |= _stored_channels(transformer)
        latent = config.get("out_channels") or 64
        if config.get("in_channels", 64) not in (latent, INPUTS * latent):
            raise ValueError(
                f"{transformer}: expected in_channels of {latent} (FLUX) or {INPUTS * latent} (a harmoniser), found "
                f"{config.get('in_channels')}"
            )
        return FluxFolder(folder, transformer, config)

    @property
    def is_harmonizer(self) -> bool:
        """Whether the first layer takes composite and condition; FLUX itself takes the noisy latent alone."""
        return self.config.get("in_channels", 64) != (self.config.get("out_channels") or 64)

    @property
    def width(self) -> int:
        """Channels of a token."""
        return self.config.get("num_attention_heads", 24) * self.config.get("attention_head_dim", 128)

    def variant(self, requested: str) -> Variant:
        """Determine the variant: `requested`, or for `auto` the one named by harmonizer.json or by the folder."""
        if not self.is_harmonizer:
            raise ValueError(
                f"{self.transformer}: expected a harmoniser, found FLUX itself; train one by `splatgraft paper train "
                "flux` or give --lora"
            )
        name = self.folder.resolve().name
        declared = declared_variant(self.folder) or (name if name in VARIANTS else None)
        if requested != "auto" and declared not in (None, requested):
            raise ValueError(f"{self.folder}: expected {requested} (--variant), found {declared}")
        return _known(declared if requested == "auto" else requested, self.folder)


def _stored_channels(transformer: Path) -> dict[str, int]:
    """Read the channels of the first and the last layer from the weights; empty if they cannot be read.

    The config of a network whose first layer was widened may still state FLUX's own.
    """
    found: dict[str, int] = {}
    for path in sorted(transformer.glob("*.safetensors")):
        try:
            with safe_open(path, "pt") as stored:
                for key, name, axis in (("in_channels", "x_embedder", 1), ("out_channels", "proj_out", 0)):
                    if f"{name}.weight" in stored.keys():  # noqa: SIM118 - it is no mapping
                        found[key] = stored.get_slice(f"{name}.weight").get_shape()[axis]
        except (OSError, SafetensorError):  # reported when the weights are loaded
            return {}
    return found


def declared_variant(folder: Path) -> str | None:
    """Read the variant from harmonizer.json in `folder`; None if there is no such file."""
    path = folder / DESCRIPTION_FILE
    if not path.is_file():
        return None
    try:
        return _known(json.loads(path.read_text(encoding="utf-8"))["variant"], path)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a variant, {' or '.join(VARIANTS)}, found {one_line(error)}") from error


def _known(variant: str | None, place: Path) -> Variant:
    if variant not in VARIANTS:
        raise ValueError(
            f"{place}: expected {DESCRIPTION_FILE} or a folder called {' or '.join(VARIANTS)}, found "
            f"{variant or 'neither'}; choose by --variant"
        )
    return variant  # pyright: ignore


def read_config(path: Path, kind: str) -> dict[str, Any]:
    """Read the diffusers config of a model of class `kind`."""
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        found = config["_class_name"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected the config of a {kind}, found {one_line(error)}") from error
    if found != kind:
        raise ValueError(f"{path}: expected the config of a {kind}, found {found}")
    return config


def load_transformer(checked: FluxFolder, *, dtype: torch.dtype) -> Any:
    """Load the transformer on the CPU, with the channels that its weights have."""
    channels = {name: checked.config[name] for name in ("in_channels", "out_channels") if checked.config.get(name)}
    return _load(diffusers_library().FluxTransformer2DModel, checked.transformer, dtype, channels)


def load_autoencoder(folder: Path) -> Autoencoder:
    """Load the autoencoder in float32 on the CPU."""
    return Autoencoder(_load(diffusers_library().AutoencoderKL, folder, torch.float32))


def _load(kind: Any, folder: Path, dtype: torch.dtype, config: Mapping[str, int] = {}) -> Any:
    variant = "bf16" if any(folder.glob("*.bf16*")) else None
    try:
        model, about = kind.from_pretrained(
            folder, torch_dtype=dtype, variant=variant, output_loading_info=True, **config
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder}: expected weights of {kind.__name__}, found {one_line(error)}") from error
    if missing := sorted(about["missing_keys"]):  # diffusers only warns
        raise ValueError(
            f"{folder}: expected all weights of config.json, found {len(missing)} missing: {missing[0]} ..."
        )
    return model


def widen_transformer(transformer: Any, init: FirstLayer = "repeat") -> None:
    """Widen the first layer for composite and condition, in place; the config is updated too (paper, Sec. 5)."""
    out = transformer.proj_out.out_features
    transformer.x_embedder = widen_layer(transformer.x_embedder, INPUTS, init)
    transformer.register_to_config(in_channels=transformer.x_embedder.in_features, out_channels=out)


def merge_lora(transformer: Any, path: Path) -> int:
    """Add a low-rank adaptation to the weights in place, by diffusers and PEFT; gives the number of adapted layers.

    Parameters that the file holds whole, such as those of the widened first layer, replace the network's.
    """
    diffusers_library()
    from diffusers.loaders.lora_pipeline import FluxLoraLoaderMixin  # pyright: ignore

    loader: Any = FluxLoraLoaderMixin
    try:
        state, alphas, metadata = loader.lora_state_dict(
            str(path.parent), weight_name=path.name, return_alphas=True, return_lora_metadata=True
        )
        low_rank = {name: tensor for name, tensor in state.items() if name.startswith(_PREFIX) and ".lora_" in name}
        layers = {name.removeprefix(_PREFIX).split(".lora_")[0] for name in low_rank}
        modules = {name for name, _ in transformer.named_modules()}
        if not layers or not layers <= modules:
            raise ValueError(f"{len(layers)} layers, among them {min(layers - modules, default='none')}")
        whole = {name.removeprefix(_PREFIX): tensor for name, tensor in state.items() if name not in low_rank}
        for name, parameter in transformer.named_parameters():
            if name in whole:
                parameter.data.copy_(whole[name].view(parameter.shape))
        loader.load_lora_into_transformer(low_rank, network_alphas=alphas, transformer=transformer, metadata=metadata)
        transformer.fuse_lora()
        transformer.unload_lora()
    except Exception as error:  # the library's converters fail with KeyError, NotImplementedError and more
        raise ValueError(f"{path}: expected a low-rank adaptation of this network, found {one_line(error)}") from error
    return len(layers)


@dataclass(frozen=True)
class FluxFiles:
    """The files of a FLUX harmoniser."""

    weights: str
    """Folder or hub id of the weights."""
    base: str | None
    """Folder or hub id of the model from which the weights were trained, for the parts that they lack."""
    lora: Path | None
    """A low-rank adaptation to merge into the weights."""
    variant: str
    """Second input of the network, or "auto" to read it from the weights' folder."""


def load_flux(files: FluxFiles, context: HarmonizerContext, *, precision: str, sampling_steps: int) -> FluxNetwork:
    """Load the network, with modulations precomputed for `sampling_steps` from each noise level of the context.

    `precision` is a key of the storage table, "float32", or "auto" for the best that fits the free memory.
    """
    say, device = context.say, context.device
    weights = hub_id(files.weights)
    if weights == _AUTHORS and files.variant != "auto":
        weights = f"{_AUTHORS}/{files.variant}"
    # the prompt is small and comes first, so that nobody waits for 24 GB in vain
    found = local_folder(weights, say, without_weights=True)
    prompt_path = _prompt_path(
        files.base or BASE, found, *([Path(files.base)] if files.base else []), found.parent, say=say
    )
    folder = local_folder(weights, say)
    checked = FluxFolder.open(folder)
    if files.lora is not None and not checked.is_harmonizer:
        found = declared_variant(files.lora.parent) if files.variant == "auto" else files.variant
        variant = _known(found, files.lora)
    else:
        variant = checked.variant(files.variant)
    # the authors' image-mask/ lies beside vae/
    places = [folder, *([Path(files.base)] if files.base else []), folder.parent]
    prompt = read_prompt(
        prompt_path,
        tokens_width=checked.config.get("joint_attention_dim", 4096),
        pooled_width=checked.config.get("pooled_projection_dim", 768),
    )
    vae = next((place / "vae" for place in places if (place / "vae").is_dir()), None)
    autoencoder = load_autoencoder(vae or local_folder(files.base or BASE, say, parts=()) / "vae")
    reason = f"as requested, on {device}"
    if precision == "auto":
        precision, reason = _best_precision(checked, context)
    say(f"flux: {precision}, {reason}")
    dtype = torch.float32 if precision == "float32" else torch.bfloat16
    transformer = load_transformer(checked, dtype=dtype)
    if files.lora is not None:
        if not checked.is_harmonizer:
            widen_transformer(transformer, "zero")  # as diffusers does for a low-rank first layer; ours is whole
        say(f"lora: {merge_lora(transformer, files.lora)} layers adapted by {files.lora}")
    transformer.eval().requires_grad_(False)
    prompt = prompt.to(torch.device("cpu"), dtype)
    starts = context.strengths
    levels = {level for start in starts for level in schnell_levels(sampling_steps, start=start)[:-1]}
    removed = bake(transformer, prompt, tuple(sorted(levels)))
    say(f"flux: {removed / 1e9:.2f} billion parameters of modulation replaced by a table")
    if precision == "offload":
        transformer.enable_group_offload(device, offload_type="block_level", num_blocks_per_group=1, use_stream=True)
    else:
        if precision == "fp8":
            transformer.enable_layerwise_casting(storage_dtype=torch.float8_e4m3fn, compute_dtype=dtype)
        transformer.to(device)
    autoencoder.network.to(device, dtype).eval().requires_grad_(False)
    return FluxNetwork(transformer, autoencoder, prompt.to(device, dtype), variant, device, dtype, starts)


def _prompt_path(base: str, *places: Path, say: Say) -> Path:
    """Find the empty prompt's embeddings, or make them if transformers and the base's text encoders can be had.

    Raises:
        ValueError: They are missing and cannot be made.
    """
    path = find_prompt(base, *places)
    if path.is_file():
        return path
    found = "no transformers (pip install 'splatgraft[text]')"
    if find_spec("transformers") is not None:
        say(f"{base}: its text encoders (T5 and CLIP, 10 GB) embed the empty prompt once")
        try:
            folder = local_folder(base, say, parts=TEXT_FOLDERS)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_prompt(path, embed_empty_prompt(str(folder)), base)
            return path
        except ValueError as error:
            found = str(error)
    raise ValueError(
        f"{path}: expected the empty prompt's embeddings, found none; `splatgraft paper train embed` makes them; here "
        f"it failed: {found}"
    )


def _best_precision(checked: FluxFolder, context: HarmonizerContext) -> tuple[str, str]:
    """Choose the best precision that fits the free memory of the device; gives it and the reason."""
    if context.device.type != "cuda":
        return "float32", f"on {context.device}; minutes per view at FLUX's size"
    doubles, singles = checked.config.get("num_layers", 19), checked.config.get("num_single_layers", 38)
    return choose_precision(
        # without the modulation layers: 12 width^2 per single block and per stream of a double block
        parameters=checked.width**2 * (24 * doubles + 12 * singles),
        working=working_bytes(pixels=context.pixels, width=checked.width),
        free=torch.cuda.mem_get_info(context.device)[0],
    )


def working_bytes(*, pixels: int, width: int) -> int:
    """Estimate the bytes of the largest activations: a token covers 256 pixels of a view, and text adds 512 tokens."""
    tokens = (pixels // 256 + 512) * width * 2 * 40  # about 40 bf16 copies of the transformer's tokens
    return max(tokens, pixels * 256 * 2 * 3)  # the decoder has three copies of 256 channels at full size


def choose_precision(*, parameters: int, working: int, free: int) -> tuple[str, str]:
    """Choose the best precision with which `parameters` and `working` bytes of activations fit into `free` bytes."""
    need = 0.0
    for precision, each in _BYTES.items():
        need = parameters * each + working + _RESERVED_BYTES
        if need <= free:
            return precision, f"needs {need / 1e9:.1f} of {free / 1e9:.1f} GB free"
    raise ValueError(
        f"GPU memory: expected {need / 1e9:.1f} GB free even with blocks on the CPU, found {free / 1e9:.1f} GB; "
        "close other programs or use smaller views"
    )
