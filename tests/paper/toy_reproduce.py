"""`paper reproduce` at toy size: real classes of diffusers, transformers and onnxruntime with tiny weights.

python toy_reproduce.py FOLDER [STAGE] runs it in FOLDER/killed; the process ends itself by SIGKILL at the stage's first
progress.
"""

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import torch

from splatgraft.cli import main
from splatgraft.runtime import console
from splatgraft_paper.commands import reproduce

TRAINING = {
    "size": "32x32", "steps": 2, "batch": 2, "precision": "no", "cpu": True, "validation-pairs": 1,
}  # fmt: skip


def write_birefnet(path, side=32, bright=None):
    """Write a network that finds a square in the middle of any picture, or what is bright in a channel."""
    import onnx
    from onnx import TensorProto, helper

    logits = np.full((1, 1, side, side), -9.0, np.float32)
    logits[..., 8:24, 8:24] = 9.0
    weights = np.zeros((1, 3, 1, 1), np.float32)
    if bright is not None:
        weights[0, bright], logits[:] = 9.0, -5.0
    constants = [onnx.numpy_helper.from_array(weights, "weights"), onnx.numpy_helper.from_array(logits, "offset")]
    nodes = [
        helper.make_node("Conv", ["image", "weights"], ["flat"]),
        helper.make_node("Add", ["flat", "offset"], ["out"]),
    ]
    given, found = (
        helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, c, side, side]) for n, c in (("image", 3), ("out", 1))
    )
    graph = helper.make_graph(nodes, "birefnet", [given], [found], constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def write_inputs(root):
    """Write data, weights and settings, and return the command's arguments without the folder of results."""
    from test_evaluate_paper import write_placed_scene
    from test_training_pairs import environment, orida
    from tiny_models import TEXT, clip_parts, pipeline_folder, removal_folder
    from tiny_pairs import rendered_folder

    flux = pipeline_folder(root / "flux", "FluxPipeline")
    diffusion = removal_folder(root / "diffusion")
    for name, part in clip_parts(TEXT).items():
        part.save_pretrained(diffusion / name)
    for folder in (flux, diffusion):
        (folder / "empty_prompt.safetensors").unlink(missing_ok=True)
    environment(root / "maps", "left", "left")
    settings = {
        "embed-flux": {"base": str(flux)},
        "embed-removal": {"base": str(diffusion)},
        "removal": {**TRAINING, "base": str(diffusion)},
        "generated": {"base": str(flux), "masks": str(write_birefnet(root / "birefnet.onnx")), "number": 2,
                      "size": "32x32", "device": "cpu"},
        "orida": {"number": 2, "size": "32x32"},
        "training": {**TRAINING, "base": str(flux)},
        "tables": {"pairs-size": "32x32", "device": "cpu", "iterations-of-consolidation": 3,
                   "methods": ["copy-paste", "off+flux/paper-l1-dssim"]},
    }  # fmt: skip
    lines = [line for name, table in settings.items()
             for line in (f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items()))]  # fmt: skip
    (root / "toy.toml").write_text("\n".join(lines) + "\n")
    given = {
        "data": write_placed_scene(root / "data"), "orida": orida(root / "orida"), "lights": root / "maps",
        "pairs": rendered_folder(root / "pairs", 3), "settings": root / "toy.toml",
    }  # fmt: skip
    words = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    return [*words, "--each", "1", "--relighter", "stand-in"]


def end_in(stage):
    """Let this process kill itself in a stage of the command."""
    running, plain, move = [None], reproduce.Reproduce._run, console._Lines.__call__

    def run(self, name, words):
        if "--plan" not in words:
            running[0] = name
        plain(self, name, words)
        if name == stage and "--plan" not in words:
            os.kill(os.getpid(), signal.SIGKILL)

    def progress(self, done, total, message):
        move(self, done, total, message)
        if running[0] == stage and done >= 1:
            os.kill(os.getpid(), signal.SIGKILL)

    reproduce.Reproduce._run, console._Lines.__call__ = run, progress


if __name__ == "__main__":
    root, *stages = sys.argv[1:]
    torch.set_num_threads(1)
    for stage in stages:
        end_in(stage)
    sys.exit(main(["paper", "reproduce", f"{root}/killed", *json.loads((Path(root) / "arguments.json").read_text())]))
