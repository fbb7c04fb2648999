"""Render one job: `python worker.py job.json`, in a Python with bpy and numpy.

A job has a scene, objects, cameras and takes. A take selects scene or object, the world, and the passes to write. An
interrupted job can be resumed, because pictures with a .done file are not rendered again.
"""

import json
import math
import os
import sys
import time

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

import bpy
import light_probe
import numpy as np
import passes
import scene_builder
import surface_points

_LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
_MID_GREY = 0.22  # linear; geometric mean of luminance after exposure, set by hand
_HIGHLIGHT = 1.3  # linear; maximum of the 97th percentile of luminance after exposure, set by hand


def _populate(job):
    scene_builder.clear()
    scene_things, objects, meshes = [], {}, {}
    for i, part in enumerate(job["scene"]["parts"]):
        scene_things.append(scene_builder.add_part(part, f"part{i:03d}", meshes))
    for i, lamp in enumerate(job["scene"]["lamps"]):
        scene_things.append(scene_builder.add_lamp(lamp, f"lamp{i:02d}"))
    for key, parts in job["objects"].items():
        is_model = isinstance(parts, dict)
        things = scene_builder.add_model(parts) if is_model else [scene_builder.add_part(p, key, meshes) for p in parts]
        for i, thing in enumerate(things):
            thing.name = f"{key}_{i:03d}"
        objects[key] = things
    cameras = [scene_builder.add_camera(camera, f"camera{i:04d}") for i, camera in enumerate(job["cameras"])]
    bpy.context.view_layer.update()
    return scene_things, objects, cameras


def _show(take, job, things, worlds):
    scene_things, objects = things
    for thing in scene_things:
        thing.hide_render = not take["scene"]
    for key, members in objects.items():
        for thing in members:
            thing.hide_render = key != take["object"]
    key = json.dumps(take.get("world") or job["scene"]["world"], sort_keys=True)
    if key not in worlds:
        worlds[key] = scene_builder.make_world(json.loads(key))
    bpy.context.scene.world = worlds[key]
    bpy.context.scene.render.film_transparent = not take["scene"]


def _exposure(job, take, cameras):
    """Return the exposure factor of the take's group, computed from quick renders and stored in exposure.json."""
    path = os.path.join(job["out"], "exposure.json")
    known = {}
    if os.path.exists(path):
        with open(path, encoding="utf-8") as source:
            known = json.load(source)
    group = take["exposure_group"]
    if group not in known:
        scene = bpy.context.scene
        settings = scene.render.resolution_percentage, scene.cycles.samples
        scene.render.resolution_percentage, scene.cycles.samples = 25, 12
        levels = []
        for camera in cameras[:: max(1, len(cameras) // 3)]:
            color = passes.render(camera, ["color"])["color"]
            luma = (color[..., :3] * _LUMA).sum(-1)[color[..., 3] > 0.5]
            if luma.size:
                levels.append((np.exp(np.log(luma + 1e-4).mean()), np.quantile(luma, 0.97)))
        scene.render.resolution_percentage, scene.cycles.samples = settings
        mean, high = np.mean(levels, 0) if levels else (0.18, 1.0)
        # the mean becomes mid grey; the exposure is lower if more than three per cent of the pixels would clip
        known[group] = float(min(_MID_GREY / max(mean, 1e-4), _HIGHLIGHT / max(high, 1e-4)))
        with open(path + ".partial", "w", encoding="utf-8") as out:
            json.dump(known, out)
        os.replace(path + ".partial", path)
    return known[group]


def _write(folder, name, take, arrays, exposure):
    for kind in take["passes"]:
        path = os.path.join(folder, f"{name}{'' if kind == 'color' else '_' + kind}")
        if kind == "color":
            color = passes.srgb(arrays["color"][..., :3] * exposure)
            transparent = not take["scene"]
            # straight alpha: premultiplied light divided by coverage before the sRGB curve
            if transparent:
                alpha = arrays["color"][..., 3:]
                straight = arrays["color"][..., :3] / np.maximum(alpha, 1e-4)
                color = np.concatenate([passes.srgb(straight * exposure), alpha], -1)
            passes.write_png(path + ".png", color)
        elif kind == "depth":
            passes.write_npy(path + ".npy", np.where(arrays["depth"] > 500, 0, arrays["depth"]).astype(np.float16))
        else:
            passes.write_png(path + ".png", arrays[kind])


def _done(folder, index, seconds):
    with open(os.path.join(folder, f"{index:04d}.done"), "w", encoding="utf-8") as out:
        out.write(f"{seconds:.2f}\n")


def main(path):
    """Render the missing files of the job at `path`."""
    with open(path, encoding="utf-8") as source:
        job = json.load(source)
    os.makedirs(job["out"], exist_ok=True)
    scene_things, objects, cameras = _populate(job)
    passes.configure(job["width"], job["height"], job["samples"], job.get("seed", 0))
    poses = [[list(row) for row in camera.matrix_world] for camera in cameras]
    with open(os.path.join(job["out"], "cameras.json.partial"), "w", encoding="utf-8") as out:
        fields = [camera["field_of_view"] for camera in job["cameras"]]
        json.dump({"width": job["width"], "height": job["height"], "field_of_view": fields, "poses": poses}, out)
    os.replace(os.path.join(job["out"], "cameras.json.partial"), os.path.join(job["out"], "cameras.json"))
    worlds = {}
    for take in job["takes"]:
        folder = os.path.join(job["out"], take["name"])
        os.makedirs(folder, exist_ok=True)
        pictures = not (take.get("probe") or take.get("surface"))
        chosen = range(len(cameras)) if pictures else [0]
        todo = [i for i in chosen if not os.path.exists(os.path.join(folder, f"{i:04d}.done"))]
        if not todo:
            continue
        _show(take, job, (scene_things, objects), worlds)
        if take.get("probe"):
            exposure = _exposure(job, take, cameras)
            world = take.get("world") or job["scene"]["world"]
            rendered = job["scene"] if take["scene"] else {**job["scene"], "lamps": []}
            panorama, suns = light_probe.measure(rendered, world, take["probe"], scene_things)
            passes.write_npy(os.path.join(folder, "0000.npy"), (panorama * exposure).astype(np.float32))
            for sun in suns:
                sun["irradiance"] = [value * exposure for value in sun["irradiance"]]
            with open(os.path.join(folder, "suns.json"), "w", encoding="utf-8") as out:
                json.dump(suns, out, indent=1)
            _done(folder, 0, 0.0)
            passes.configure(job["width"], job["height"], job["samples"], job.get("seed", 0))
            continue
        if take.get("surface"):
            things = objects[take["object"]] if take["object"] else scene_things
            passes.write_npy(
                os.path.join(folder, "0000.npy"),
                surface_points.sample_points(things, take["surface"], job.get("seed", 0)),
            )
            _done(folder, 0, 0.0)
            continue
        matte = [thing.name for thing in objects.get(take["object"], [])]
        exposure = _exposure(job, take, cameras)
        for i in todo:
            begin = time.time()
            arrays = passes.render(cameras[i], take["passes"], matte)
            if not np.isfinite(arrays["color"]).all():
                raise ValueError(f"{folder}/{i:04d}: expected finite colours, found {math.nan}")
            _write(folder, f"{i:04d}", take, arrays, exposure)
            _done(folder, i, time.time() - begin)
            print(f"rendered {take['name']} {i:04d} {time.time() - begin:.1f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
