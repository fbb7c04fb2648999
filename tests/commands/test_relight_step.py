"""The command `relight` on explicit paths: which objects it takes the old light off."""

from dataclasses import replace
from pathlib import Path

import torch
from shapes import surfels
from tiny_project import ball, photograph, plane

from splatgraft.cli import main
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import read_rgb
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.formats.placement import ObjectPlacement, Placement, write_placement


def relight_command(folder: Path, *more: str) -> int:
    """The command with the files that both tests write."""
    paths = {
        "target": "target.ply",
        "placement": "placement.json",
        "cameras": "target/transforms.json",
        "surroundings": "surroundings.ply",
        "object-cameras": "source/transforms.json",
        "taken": "own.ply",
        "out": "relit",
    }
    words = [word for name, path in paths.items() for word in (f"--{name}", str(folder / path))]
    return main(["relight", *words, *more])


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
    assert relight_command(tmp_path, "--light", "gain") == 0
    strange, one, other = read_gaussians(tmp_path / "relit" / "scene.ply").sh[-3 * ball().count :].chunk(3)
    assert torch.equal(strange[:, 0], ball().sh[:, 0])
    assert float((one - other).abs().max()) < 0.15 * float((one - ball().sh).abs().mean())
    assert float((one - ball().sh).mean()) > 0.05


def test_the_lights_of_both_places_are_drawn_past_an_object_without_gaussians(tmp_path: Path):
    def room(gray: float) -> Gaussians:
        away = 20 * even_directions(2000)
        return concatenate([plane((gray, gray, gray)), surfels(away, -away, width=1.0, srgb=gray)])

    target, surroundings = room(0.8), room(0.25)
    photograph(tmp_path / "target", target, None)
    photograph(tmp_path / "source", surroundings, ball())
    write_gaussians(tmp_path / "target.ply", target)
    write_gaussians(tmp_path / "surroundings.ply", surroundings)
    write_gaussians(tmp_path / "nothing.ply", ball().select(torch.zeros(0, dtype=torch.int64)))
    write_gaussians(tmp_path / "own.ply", ball())
    here = Similarity(0.5, torch.eye(3), torch.zeros(3))
    objects = tuple(ObjectPlacement(here, tmp_path / name) for name in ("nothing.ply", "own.ply"))
    write_placement(tmp_path / "placement.json", Placement(objects))
    assert relight_command(tmp_path) == 0
    drawn = {path.name: read_rgb(path) for path in (tmp_path / "relit").glob("*.png")}
    # numbered as the placement's objects, as in the report
    assert "Where object 2 comes from" in (tmp_path / "relit" / "light.txt").read_text()
    assert sorted(drawn) == ["light.png", "source_light_2.png"]
    for picture in drawn.values():
        assert picture.shape == (256, 768, 3)
    assert float(drawn["light.png"].mean()) > float(drawn["source_light_2.png"].mean()) + 0.05
