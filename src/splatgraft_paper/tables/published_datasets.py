"""Published data sets with ground truth: the authors' and SynCom (CC-BY 4.0), downloaded on request."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PublishedDataset:
    """Where a data set is and what of it is needed."""

    repository: str
    """On Hugging Face."""
    parts: tuple[str, ...]
    """Folders that are fetched, relative to the data set."""


DOT3D = PublishedDataset(
    repository="nviolante/dot3d",
    parts=("data_3d/**", "data_rotation/**", "results_3d/**", "results_rotation/**", "README.md"),
)
SYNCOM = PublishedDataset(
    repository="yGaoJiany/SynCom",
    # of the objects not the linear .exr pictures, which are not read
    parts=(
        "composition/**", "scene/*/train/**", "object/*/train/cameras.json", "object/*/train/*.png", "README.md",
    ),
)  # fmt: skip
PUBLISHED = {"dot3d": DOT3D, "syncom": SYNCOM}
"""By the name that `evaluate paper --dataset` has for it."""


def download(dataset: PublishedDataset, folder: Path) -> Path:
    """Download a data set from Hugging Face into `folder`; existing files are kept.

    Args:
        dataset: The data set.
        folder: Receives the files.

    Raises:
        ModuleNotFoundError: huggingface_hub is not installed.
        ValueError: The data set cannot be reached.
    """
    import huggingface_hub

    # the card draws the folders in dot3d_data/, the file list may have them at the top
    patterns = [pattern for part in dataset.parts for pattern in (part, f"*/{part}")]
    try:
        huggingface_hub.snapshot_download(
            dataset.repository, repo_type="dataset", local_dir=str(folder), allow_patterns=patterns
        )
    except (OSError, ValueError, huggingface_hub.errors.HfHubHTTPError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"https://huggingface.co/datasets/{dataset.repository}: expected to fetch {', '.join(dataset.parts)}, "
            f"found {type(error).__name__}: {reason}"
        ) from error
    return folder
