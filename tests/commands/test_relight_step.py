"""The command `relight` on explicit paths: which objects it takes the old light off."""

from dataclasses import replace
from pathlib import Path

import torch
from tiny_project import ball, photograph, plane

from splatgraft.cli import main
from splatgraft.core.gaussians import concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.formats.placement import ObjectPlacement, Placement, write_placement


def test_copies_lose_the_same_old_light_and_a_strange_object_keeps_its_own(tmp_path: Path):
    # the source's floor is dark, the target's bright
    target = concatenate([plane((0.8, 0.8, 0.8)), replace(ball(), means=ball().means + torch.tensor([0.0, 0.0, 2.0]))])
    photograph(tmp_path / "target", target, None)
    photograph(tmp_path / "source", plane((0.25, 0.25, 0.25)), ball())
    write_gaussians(tmp_path / "target.ply", target)
    write_gaussians(tmp_path / "surroundings.ply", plane((0.25, 0.25, 0.25)))
    files = [tmp_path / "strange.ply", tmp_path / "own.ply", tmp_path / "own.ply"]
    for path in files[:2]:
        write_gaussians(path, ball())
    # the copies stand where as much of the target is around them
    places = ((0.0, 0.5, 0.0), (-0.2, 0.0, 0.0), (0.2, 0.0, 0.0))
    moves = [Similarity(0.5, torch.eye(3), torch.tensor(place)) for place in places]
    objects = tuple(ObjectPlacement(move, path) for move, path in zip(moves, files, strict=True))
    write_placement(tmp_path / "placement.json", Placement(objects))
    paths = {
        "target": "target.ply",
        "placement": "placement.json",
        "cameras": "target/transforms.json",
        "surroundings": "surroundings.ply",
        "object-cameras": "source/transforms.json",
        "taken": "own.ply",
        "out": "relit",
    }
    words = [word for name, path in paths.items() for word in (f"--{name}", str(tmp_path / path))]
    assert main(["relight", *words, "--light", "gain"]) == 0
    strange, one, other = read_gaussians(tmp_path / "relit" / "scene.ply").sh[-3 * ball().count :].chunk(3)
    assert torch.equal(strange[:, 0], ball().sh[:, 0])
    assert float((one - other).abs().max()) < 0.15 * float((one - ball().sh).abs().mean())
    assert float((one - ball().sh).mean()) > 0.05
