"""Every table and key of project.toml, and the commented project.toml that lists them all."""

from pathlib import Path

from splatgraft.project.layout import Layout
from splatgraft.project.reference import Key, KeyTable, describe_table
from splatgraft.workflow.flow import STEPS, default_paths

_CAPTURE_KEYS = {
    "source": "The capture with the object; also takes every key of [capture], for this capture alone.",
    "target": "The capture that receives the object; also takes every key of [capture], for this capture alone.",
}
_SIDE_KEYS = (
    Key("capture", "path", "required without scene", "Photos, a video, a COLMAP folder or one with transforms.json.",
        example='"photos"'),
    Key("scene", "path", "none", "A trained scene (.ply, .spz, .splat), which is taken over instead of being "
        "reconstructed; without a capture, pictures are made of it.", example='"trained.ply"'),
)  # fmt: skip


def project_keys() -> tuple[KeyTable, ...]:
    """Every table of project.toml with all its keys: name, type, default and meaning, in the order of the flow.

    Paths of results are relative to the folder of project.toml. [source.reconstruct] and [target.reconstruct] take the
    keys of [reconstruct] for one capture alone.
    """
    given = default_paths(Layout(Path()))
    sides = tuple(KeyTable(side, meaning, _SIDE_KEYS) for side, meaning in _CAPTURE_KEYS.items())
    # [capture] and [reconstruct] serve both sides: one path for both would be wrong
    steps = tuple(
        describe_table(
            kind.__name__.lower(),
            kind,
            given=given.get(kind),
            omitted=frozenset({"out"} if kind in given else {"out", "capture"}),
        )
        for kind in STEPS
    )
    return sides + steps
