"""Render one view with its passes inside Blender, and write images."""

import os
import struct
import tempfile
import zlib

import bpy
import numpy as np


def write_png(path, array):
    """Write an 8-bit grey, RGB or RGBA image from values in [0, 1], atomically."""
    values = np.clip(np.rint(np.nan_to_num(array) * 255), 0, 255).astype(np.uint8)
    h, w = values.shape[:2]
    channels = 1 if values.ndim == 2 else values.shape[2]
    rows = np.concatenate([np.zeros((h, 1), np.uint8), values.reshape(h, w * channels)], 1)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", w, h, 8, {1: 0, 3: 2, 4: 6}[channels], 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    partial = path + ".partial"
    with open(partial, "wb") as out:
        out.write(b"\x89PNG\r\n\x1a\n" + body)
    os.replace(partial, path)


def write_npy(path, array):
    """Write a numpy array, atomically."""
    partial = path + ".partial"
    with open(partial, "wb") as out:
        np.save(out, array)
    os.replace(partial, path)


def srgb(linear):
    """Convert linear light to sRGB (IEC 61966-2-1)."""
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def configure(width, height, samples, seed):
    """Set up Cycles on the CPU with the denoiser, and plain sRGB without a tone curve."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 8, 5, 4
    scene.cycles.sample_clamp_indirect = 8.0
    scene.cycles.blur_glossy = 0.5
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.use_persistent_data = True
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_settings.exposure = 0.0
    layer = bpy.context.view_layer
    layer.use_pass_z = True
    layer.use_pass_cryptomatte_object = True


def render(camera, names, matte=()):
    """Render one camera and return arrays by pass: color (linear RGBA), depth, mask."""
    scene = bpy.context.scene
    scene.camera = camera
    with tempfile.TemporaryDirectory() as folder:
        _write_passes(folder, names, matte)
        bpy.ops.render.render(write_still=False)
        found = {name: _read(folder, name) for name in names}
    for name in ("depth", "mask"):
        if name in found:
            found[name] = found[name][..., 0]
    return found


def _write_passes(folder, names, matte):
    """Build a compositor tree that writes the passes as EXR files into `folder`."""
    scene = bpy.context.scene
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    layers = tree.nodes.new("CompositorNodeRLayers")
    out = tree.nodes.new("CompositorNodeOutputFile")
    out.base_path = folder
    out.format.file_format, out.format.color_depth, out.format.color_mode = "OPEN_EXR", "32", "RGBA"
    out.file_slots.clear()
    sockets = {"color": "Image", "depth": "Depth"}
    for name in names:
        out.file_slots.new(name)
        if name == "mask":
            crypto = tree.nodes.new("CompositorNodeCryptomatteV2")
            crypto.source = "RENDER"
            crypto.scene = scene
            crypto.matte_id = ",".join(matte)
            tree.links.new(crypto.outputs["Matte"], out.inputs[name])
        else:
            tree.links.new(layers.outputs[sockets[name]], out.inputs[name])


def _read(folder, name):
    path = os.path.join(folder, next(f for f in os.listdir(folder) if f.startswith(name)))
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Non-Color"
    w, h = image.size
    pixels = np.empty(w * h * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(h, w, 4)[::-1]
