"""The undo history on disk, in the editor's own folder.

Each state is a file named by the hash of its content, and the history is a list of these names. Undo is therefore
unbounded, needs little memory, and survives the end of the editor.
"""

import base64
import hashlib
import json
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatgraft.editor.state import EditState
from splatgraft.project.layout import EDITOR_FOLDER
from splatgraft.project.placement import object_from_json, object_to_json
from splatgraft.project.prompts import prompts_from_json, prompts_to_json
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write, writable

_HISTORY_FILE, _STATES_FOLDER = "history.json", "states"
_IN_MEMORY = 20
"""Number of states held in memory, because memos compare the parts of states by identity."""


@dataclass(frozen=True)
class History:
    """Names of all states in order, undone ones last."""

    names: tuple[str, ...]
    """Names, oldest first."""
    at: int = 0
    """Position of the current state."""

    @property
    def present(self) -> str:
        """Name of the current state."""
        return self.names[self.at]

    @property
    def undone(self) -> int:
        """Number of undone states."""
        return len(self.names) - 1 - self.at

    def pushed(self, name: str) -> "History":
        """Return the history after a new step; undone states are discarded."""
        return History((*self.names[: self.at + 1], name), self.at + 1)

    def moved(self, steps: int) -> "History":
        """Go forward by a number of steps, or back by a negative one; return the same object if impossible."""
        at = self.at + steps
        return replace(self, at=at) if 0 <= at < len(self.names) else self


class StateStore:
    """The stored states of one project, and its history."""

    def __init__(self, root: Path, *, project_folder: Path) -> None:
        """Open the store of the results in `root` without reading; objects' paths are relative to the project."""
        self._folder, self._conversions = root / EDITOR_FOLDER, _conversions(project_folder)
        self._states = self._folder / _STATES_FOLDER
        self._recent: OrderedDict[str, EditState] = OrderedDict()

    def name(self, state: EditState) -> str:
        """Return the name of a state, which need not be stored."""
        return self._named(state)[0]

    def save(self, state: EditState) -> str:
        """Write the state unless it is stored already; return its name."""
        with writable(self._states):
            self._states.mkdir(parents=True, exist_ok=True)
        name, content = self._named(state)
        if not self._file(name).is_file():
            with atomic_write(self._file(name)) as stream:
                stream.write(content)
        return name

    def read(self, name: str) -> EditState:
        """Read a state by name; raise ValueError or OSError if its file is damaged or missing."""
        if name not in self._recent:
            content = self._file(name).read_bytes()
            if _name(content) != name:
                raise ValueError(f"{self._file(name)}: expected an earlier state, found other bytes")
            self._remember(name, EditState(**self._converted(json.loads(content), 1)))
        self._recent.move_to_end(name)
        return self._recent[name]

    def read_history(self) -> History | None:
        """Read the history and delete unused states; return None if it is missing or damaged."""
        try:
            found = json.loads((self._folder / _HISTORY_FILE).read_text(encoding="utf-8"))
            history = History(tuple(found["names"]), found["at"])
            _ = history.present  # LookupError if the position is outside of the names
            used = {self._file(name) for name in history.names}
        except (OSError, ValueError, LookupError, TypeError):
            return None
        if not all(path.is_file() for path in used):
            return None
        for path in set(self._states.iterdir()) - used:
            path.unlink()
        return history

    def save_history(self, history: History) -> None:
        """Write the list of names."""
        with atomic_write(self._folder / _HISTORY_FILE) as stream:
            stream.write(json.dumps(asdict(history)).encode())

    def _named(self, state: EditState) -> tuple[str, bytes]:
        content = json.dumps(self._converted(vars(state), 0), sort_keys=True).encode()
        name = _name(content)
        self._remember(name, state)
        return name, content

    def _converted(self, values: Mapping[str, Any], way: int) -> dict[str, Any]:
        """Convert fields to JSON's types (0) or back (1); None stays None."""
        pairs = self._conversions
        return {
            name: pairs[name][way](one) if name in pairs and one is not None else one for name, one in values.items()
        }

    def _file(self, name: str) -> Path:
        return self._states / f"{name}.json"

    def _remember(self, name: str, state: EditState) -> None:
        self._recent.setdefault(name, state)
        while len(self._recent) > _IN_MEMORY:
            self._recent.popitem(last=False)


def _conversions(project_folder: Path) -> dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]]:
    """Return the conversions of a state's fields to JSON's types and back; other fields have such types."""
    return {
        "objects": (
            lambda items: [object_to_json(item, project_folder) for item in items],
            lambda entries: tuple(object_from_json(entry, project_folder, "objects") for entry in entries),
        ),
        "erased": (_packed, partial(_unpacked, kind=np.bool_)),
        "corrections": (_packed, partial(_unpacked, kind=np.int8)),
        "box": (list, tuple),
        "prompts": (prompts_to_json, partial(prompts_from_json, where="prompts")),
        "light": (light_to_json, light_from_json),
        "weights": (asdict, lambda weights: LayerWeights(**weights)),
    }


def _packed(flags: Tensor) -> str:
    """Encode one byte per Gaussian as compressed text."""
    return base64.b64encode(zlib.compress(flags.numpy().tobytes())).decode()


def _unpacked(text: str, kind: type[np.generic]) -> Tensor:
    return torch.from_numpy(np.frombuffer(bytearray(zlib.decompress(base64.b64decode(text))), kind))


def _name(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
