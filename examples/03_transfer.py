"""Transfer an object of one capture into the scene of another: composition, light, harmonisation, measurement.

The benchmark scene has a ground truth, and both of its captures share world coordinates. For captures of your own,
`sg.place_object` finds a place (05_several_objects.py).
"""

from pathlib import Path

import splatgraft as sg

DATA = Path(__file__).parents[1] / "data" / "benchmark" / "terrace"
SHORT = sg.ReconstructOptions(iterations=60, budget=4000)


def main() -> None:
    source, target, truth = (sg.read_capture(DATA / name).resized(0.5) for name in ("source", "target", "ground_truth"))
    source_scene, target_scene = sg.reconstruct(source, SHORT), sg.reconstruct(target, SHORT)
    cut = sg.segment(source_scene, source, solidify=sg.SolidifyOptions(iterations=40))

    composite = sg.compose(target_scene, [cut.object], target_from_objects=[sg.Similarity.identity()])
    relit = sg.relight(composite, target.cameras, sources=[sg.SourceScene(cut.surroundings, source.cameras)])
    print(*relit.report, sep="\n")

    scene, is_object = composite.bake()
    prior, _ = relit.bake()
    test = sg.held_out(len(target))
    cameras = target.select(~test).cameras[::3]
    views = sg.render_views(scene, is_object, cameras, prior=prior)
    harmonized = sg.harmonize(views, "none")  # or an image model, sg.make_harmonizer(sg.FluxOptions(weights="dot3d"))
    result = sg.consolidate(prior, cameras, harmonized)

    expected = sg.true_views(truth.select(test), target)
    images, backgrounds = (list(sg.render(s, target.cameras[test]).color) for s in (result, target_scene))
    metrics = sg.evaluate(images, expected, backgrounds=backgrounds)
    print(f"{result.count} Gaussians; held-out views: {metrics['psnr']:.1f} dB, object {metrics['object_psnr']:.1f} dB")


if __name__ == "__main__":
    main()
