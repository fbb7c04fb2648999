"""Downloads of model weights from the Hugging Face hub, and the licences named there."""

from pathlib import Path

from splatgraft.harmonization.flux.weights.diffusers_library import one_line


def download(repository: str, patterns: list[str]) -> Path:
    """Download the files of a hub repository that match `patterns`, or find them in the hub's cache.

    Raises:
        ValueError: the download fails.
    """
    import huggingface_hub

    try:
        return Path(huggingface_hub.snapshot_download(repository, allow_patterns=patterns))
    except Exception as error:  # network, missing repository, gated licence: the user can correct all of them
        raise ValueError(
            f"{repository}: expected a folder here or a repository on the Hugging Face hub that can be downloaded, "
            f"found {one_line(error)}"
        ) from error


def licence_of(repository: str) -> str:
    """The licence named by a hub repository; `unknown` where the hub cannot be reached or names none."""
    import huggingface_hub

    try:
        card = huggingface_hub.model_info(repository).card_data
    except Exception:  # a missing card or no network must not stop what is already downloaded
        return "unknown"
    return str(getattr(card, "license", None) or "unknown")
