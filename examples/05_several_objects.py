"""Place two objects of two captures in one scene; they light and shade each other."""

import tempfile
from pathlib import Path

import splatgraft as sg

ROOT = Path(__file__).parents[1]
CAPTURES = (ROOT / "data" / "vase", ROOT / "src" / "splatgraft" / "demo_captures" / "bananas")
SHORT = sg.ReconstructOptions(iterations=60, budget=4000)


def main() -> None:
    target = sg.read_capture(ROOT / "data" / "room").resized(0.25)
    room = sg.reconstruct(target, SHORT)
    composite = sg.compose(room, [], target_from_objects=[])
    sources: list[sg.SourceScene] = []
    for folder in CAPTURES:
        source = sg.read_capture(folder).resized(0.25)
        cut = sg.segment(sg.reconstruct(source, SHORT), source, solidify=sg.SolidifyOptions(iterations=40))
        sources.append(sg.SourceScene(cut.surroundings, source.cameras))
        # with the earlier objects in the scene each finds a place of its own; both captures are in metres
        scene, _ = composite.merged()
        placed = sg.place_object(
            scene,
            cut.object,
            cameras=(target.cameras, source.cameras),
            surroundings=cut.surroundings,
            options=sg.PlaceOptions(scale=1.0),
        )
        print(
            folder.name,
            "at",
            [round(x, 2) for x in placed.support.point.tolist()],
            *(note.text for note in placed.warnings),
        )
        composite = composite.with_object(cut.object, placed.target_from_object)

    relit = sg.relight(composite, target.cameras, sources=sources)
    print(*relit.report, sep="\n")
    scene, is_object = relit.bake()
    out = Path(tempfile.mkdtemp(prefix="splatgraft_"))
    sg.save(out / "scene.ply", scene)
    sg.save_image(out / "view.png", sg.render(scene, target.cameras[0]).color[0])
    print(f"{int(is_object.sum())} of {scene.count} Gaussians are the objects'; {out / 'view.png'}")


if __name__ == "__main__":
    main()
