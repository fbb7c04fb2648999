"""The undo history on disk, in the editor's own folder.

Each state is a file named by the hash of its content, and the history is a list of these names. Undo is therefore
unbounded, needs little memory, and survives the end of the editor.
"""

import hashlib
import json
import os
from collections import OrderedDict
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatgraft.core.similarity import Similarity
from splatgraft.editor.state import EditState
from splatgraft.formats.placement import ObjectPlacement
from splatgraft.formats.prompts import prompts_from_json, prompts_to_json
from splatgraft.project.layout import EDITOR_FOLDER
from splatgraft.relighting import LayerWeights, light_from_json, light_to_json
from splatgraft.runtime.files import atomic_write

_HISTORY_FILE, _STATES_FOLDER = "history.json", "states"
_IN_MEMORY = 20
"""Number of states held in memory; memos recognise such a state by the identity of its parts."""


@dataclass(frozen=True)
class History:
    """The names of the present state, of all earlier ones, and of those that were undone."""

    present: str
    """The current state."""
    past: tuple[str, ...] = ()
    """Earlier states, oldest first."""
    future: tuple[str, ...] = ()
    """Undone states, the most recently undone last."""

    def pushed(self, name: str) -> "History":
        """The history after a new step; undone states are discarded."""
        return History(name, (*self.past, self.present))

    def undone(self) -> "History":
        """One step back; itself where there is none."""
        if not self.past:
            return self
        return History(self.past[-1], self.past[:-1], (*self.future, self.present))

    def redone(self) -> "History":
        """One step forward again; itself where there is none."""
        if not self.future:
            return self
        return History(self.future[-1], (*self.past, self.present), self.future[:-1])


class StateStore:
    """The stored states of one project, and its history."""

    def __init__(self, root: Path, *, project_folder: Path) -> None:
        """Open the store of the results in `root` without reading; objects' paths are relative to the project."""
        self._folder, self._project_folder = root / EDITOR_FOLDER, project_folder
        self._recent: OrderedDict[str, EditState] = OrderedDict()
        self._arrays: dict[int, tuple[Tensor, str]] = {}

    def save(self, state: EditState) -> str:
        """Write the state unless it is stored already; returns its name."""
        (self._folder / _STATES_FOLDER).mkdir(parents=True, exist_ok=True)
        content = json.dumps(self._to_json(state), sort_keys=True).encode()
        name = _name(content)
        self._write(self._path(name, ".json"), content)
        self._remember(name, state)
        return name

    def read(self, name: str) -> EditState:
        """The state of that name.

        Raises:
            ValueError: If its file is not what was stored.
            OSError: If its file is missing.
        """
        if name not in self._recent:
            path = self._path(name, ".json")
            content = path.read_bytes()
            if _name(content) != name:
                raise ValueError(f"{path}: expected an earlier state, found other bytes")
            self._remember(name, self._from_json(json.loads(content)))
        self._recent.move_to_end(name)
        return self._recent[name]

    def read_history(self) -> History | None:
        """Read the history and delete states that are not in it; None where none is stored, or it is damaged."""
        try:
            found = json.loads((self._folder / _HISTORY_FILE).read_text(encoding="utf-8"))
            history = History(found["present"], tuple(found["past"]), tuple(found["future"]))
            self._remove_unused({history.present, *history.past, *history.future})
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return history

    def save_history(self, history: History) -> None:
        """Write the list of names."""
        with atomic_write(self._folder / _HISTORY_FILE) as stream:
            stream.write(json.dumps(asdict(history)).encode())

    def _path(self, name: str, suffix: str) -> Path:
        return self._folder / _STATES_FOLDER / f"{name}{suffix}"

    def _write(self, path: Path, content: bytes) -> None:
        if not path.is_file():
            with atomic_write(path) as stream:
                stream.write(content)

    def _remember(self, name: str, state: EditState) -> None:
        self._recent.setdefault(name, state)
        while len(self._recent) > _IN_MEMORY:
            self._recent.popitem(last=False)
        used = {id(array) for state in self._recent.values() for array in (state.erased, state.corrections)}
        self._arrays = {key: value for key, value in self._arrays.items() if key in used}

    def _remove_unused(self, used: set[str]) -> None:
        """Delete all states but those in `used`, and all arrays that these do not refer to."""
        arrays: set[str | None] = set()
        for path in (self._path(name, ".json") for name in used):
            found = json.loads(path.read_text(encoding="utf-8"))
            arrays |= {found["erased"], found["corrections"]}
        for path in (self._folder / _STATES_FOLDER).glob("*"):
            if path.stem not in used and path.stem not in arrays:
                path.unlink()

    # a state as JSON; arrays are stored in separate files, because most steps do not change them

    def _to_json(self, state: EditState) -> dict[str, Any]:
        objects = None if state.objects is None else [self._object_to_json(item) for item in state.objects]
        return {
            "objects": objects,
            "erased": self._save_array(state.erased),
            "corrections": self._save_array(state.corrections),
            "mask_source": state.mask_source,
            "box": state.box,
            "keep": state.keep,
            "prompts": None if state.prompts is None else prompts_to_json(state.prompts),
            "light": None if state.light is None else light_to_json(state.light),
            "weights": asdict(state.weights),
            "harmonizer": state.harmonizer,
        }

    def _from_json(self, fields: dict[str, Any]) -> EditState:
        objects, box, prompts, light = (fields.get(name) for name in ("objects", "box", "prompts", "light"))
        return EditState(
            objects=None if objects is None else tuple(self._object_from_json(item) for item in objects),
            erased=self._read_array(fields["erased"]),
            corrections=self._read_array(fields["corrections"]),
            mask_source=fields["mask_source"],
            box=None if box is None else (box[0], box[1], box[2], box[3], box[4], box[5]),
            keep=fields["keep"],
            prompts=None if prompts is None else prompts_from_json(prompts, "prompts"),
            light=None if light is None else light_from_json(light),
            weights=LayerWeights(**fields["weights"]),
            harmonizer=fields["harmonizer"],
        )

    def _object_to_json(self, item: ObjectPlacement) -> dict[str, Any]:
        placement, path = item.target_from_object, item.object_path
        return {
            "scale": placement.scale,
            "rotation": placement.rotation.tolist(),
            "translation": placement.translation.tolist(),
            "object": None if path is None else os.path.relpath(path, self._project_folder),
        }

    def _object_from_json(self, fields: dict[str, Any]) -> ObjectPlacement:
        rotation, translation = (torch.tensor(fields[name]) for name in ("rotation", "translation"))
        placement = Similarity(scale=fields["scale"], rotation=rotation, translation=translation)
        return ObjectPlacement(placement, None if fields["object"] is None else self._project_folder / fields["object"])

    def _save_array(self, array: Tensor | None) -> str | None:
        if array is None:
            return None
        known = self._arrays.get(id(array))
        if known is not None:
            return known[1]
        numbers = array.cpu().numpy()
        name = _name(str(numbers.dtype).encode() + numbers.tobytes())
        content = BytesIO()
        np.savez_compressed(content, numbers=numbers)
        self._write(self._path(name, ".npz"), content.getvalue())
        self._arrays[id(array)] = (array, name)
        return name

    def _read_array(self, name: str | None) -> Tensor | None:
        if name is None:
            return None
        # the same tensor as in a recent state, so that memos of it stay valid
        for array, known in self._arrays.values():
            if known == name:
                return array
        with np.load(self._path(name, ".npz"), allow_pickle=False) as content:
            array = torch.from_numpy(content["numbers"])
        self._arrays[id(array)] = (array, name)
        return array


def _name(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
