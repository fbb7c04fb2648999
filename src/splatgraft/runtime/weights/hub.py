"""Fetches weights from the Hugging Face hub, or from addresses, into the store; the only caller of the hub's client.

Only the files that `layout.needed_files` chooses are fetched. A fetch that was interrupted continues where it was.
Every file is compared with the hub's size and SHA-256.
"""

import shutil
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splatgraft.runtime.files import room_on_disk
from splatgraft.runtime.weights.catalogue import ModelWeights
from splatgraft.runtime.weights.layout import HubFile, needed_files
from splatgraft.runtime.weights.store import StoredWeights, check_files, is_whole, sha256_of, write_stored

Say = Callable[[str], None]
_BLOCK = 1 << 20
_TIMEOUT_SECONDS = 60
_HASH_DIGITS = 8
"""torch's file names end with this many digits of their SHA-256."""


@dataclass(frozen=True)
class Repository:
    """What the hub says of a repository."""

    commit: str
    licence: str
    gated: bool
    files: tuple[HubFile, ...]


def describe(repository: str, revision: str = "main", *, endpoint: str | None = None) -> Repository:
    """Ask the hub for the files, the licence and the gating of a repository.

    Raises:
        ValueError: There is no such repository, or no network.
    """
    from huggingface_hub import HfApi

    try:
        found = HfApi(endpoint=endpoint).model_info(repository, revision=revision, files_metadata=True)
    except Exception as error:
        raise ValueError(_line(repository, error)) from error
    files = [
        HubFile(entry.rfilename, entry.size or 0, entry.lfs.sha256 if entry.lfs else None)
        for entry in found.siblings or ()
    ]
    licence = str(getattr(found.card_data, "license", None) or "unknown")
    return Repository(found.sha or revision, licence, bool(found.gated), tuple(files))


def may_read(repository: str, *, endpoint: str | None = None) -> bool:
    """Whether files of a gated repository would be given to this user.

    Raises:
        ValueError: There is no such repository, or no network.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.errors import GatedRepoError

    try:
        HfApi(endpoint=endpoint).auth_check(repository)
    except GatedRepoError:
        return False
    except Exception as error:
        raise ValueError(_line(repository, error)) from error
    return True


def fetch(model: ModelWeights, folder: Path, *, say: Say, endpoint: str | None = None) -> StoredWeights:
    """Fetch what a model needs into `folder`; files that are whole are left alone.

    Args:
        model: The entry of the catalogue, or one made for a repository.
        folder: For the files, named as in the repository.
        say: Takes messages: the licence and the size, before anything is fetched.
        endpoint: Address of the hub; the public one where not given.

    Returns:
        What is now there, as recorded.

    Raises:
        ValueError: Something is not there, gated, damaged, or there is no room or no network.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if model.urls:
        files = [_fetch_url(url, folder, say) for url in model.urls]
        stored = StoredWeights(model.name, "", model.licence, tuple(files))
        write_stored(folder, stored)
        return stored
    there = describe(model.repository, model.revision, endpoint=endpoint)
    files = needed_files(there.files, model)
    missing = [file for file in files if not is_whole(folder, file)]
    need, free = sum(file.size for file in missing), shutil.disk_usage(folder).free
    licence = there.licence if there.licence != "unknown" else model.licence
    say(
        f"weights: {len(missing)} of {len(files)} files of {model.repository} ({need / 1e9:.2f} GB) into {folder}; "
        f"licence: {licence}, read it before use"
    )
    if need > free:
        raise ValueError(
            f"{folder}: expected {need / 1e9:.1f} GB of free disk for {model.repository}, found {free / 1e9:.1f} GB"
        )
    from huggingface_hub import hf_hub_download

    for file in missing:
        try:
            with room_on_disk(folder):
                hf_hub_download(model.repository, file.path, revision=there.commit, local_dir=folder, endpoint=endpoint)
        except Exception as error:
            raise ValueError(_line(model.repository, error)) from error
    if faults := check_files(folder, missing):
        raise ValueError(faults[0])
    stored = StoredWeights(model.repository, there.commit, licence, tuple(files))
    write_stored(folder, stored)
    return stored


def _fetch_url(url: str, folder: Path, say: Say) -> HubFile:
    """Fetch one file by its address, continuing a part of it that is there; checked by the hash in its name, if any."""
    path, part = folder / url.rsplit("/", maxsplit=1)[1], folder / (url.rsplit("/", maxsplit=1)[1] + ".part")
    if not path.is_file():
        begun = part.stat().st_size if part.is_file() else 0
        say(f"weights: {url}" + (f", from byte {begun} on" if begun else ""))
        request = urllib.request.Request(url, headers={"Range": f"bytes={begun}-"} if begun else {})
        try:
            with room_on_disk(folder), urllib.request.urlopen(request, timeout=_TIMEOUT_SECONDS) as answer:
                begun = begun if answer.status == 206 else 0  # a server that does not know Range begins anew
                expected = begun + int(answer.headers.get("Content-Length", -1))
                with part.open("ab" if begun else "wb") as stream:
                    shutil.copyfileobj(answer, stream, _BLOCK)
        except OSError as error:
            raise ValueError(f"{url}: expected a file to fetch, found {' '.join(str(error).split())[:160]}") from error
        size = part.stat().st_size
        if size < expected:
            raise ValueError(f"{url}: expected {expected} bytes, found {size}; the same command continues from there")
        digest, named = sha256_of(part), path.stem.rpartition("-")[2]
        if len(named) == _HASH_DIGITS and not digest.startswith(named):
            part.unlink()
            raise ValueError(f"{url}: expected the SHA-256 {named}..., found {digest[:_HASH_DIGITS]}...; fetch again")
        part.replace(path)
    return HubFile(path.name, path.stat().st_size, sha256_of(path))


def _line(repository: str, error: Exception) -> str:
    """One line for what the hub's client raises, and how to mend it."""
    from huggingface_hub import errors

    page = f"https://huggingface.co/{repository}"
    if isinstance(error, errors.GatedRepoError):
        return (
            f"{repository}: expected access to a gated repository, found none; agree to its terms on {page}, make a "
            "token with read access at https://huggingface.co/settings/tokens and enter it after `hf auth login`"
        )
    if isinstance(error, errors.RepositoryNotFoundError):
        return (
            f"{repository}: expected a repository on the Hugging Face hub, found none of that name, or one that is "
            f"private; `splatgraft weights list` names the present ones"
        )
    if isinstance(error, ValueError) and "found" in str(error):
        return str(error)
    found = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
    return (
        f"{repository}: expected a folder here or a repository on the Hugging Face hub that can be downloaded, found "
        f"{found}; without a network, copy the folder that `splatgraft weights fetch` made elsewhere"
    )
