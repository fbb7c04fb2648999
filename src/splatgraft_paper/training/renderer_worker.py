"""Run DiffusionRenderer's programs repeatedly in one process and load its models once.

`relighters.py` starts this file with DiffusionRenderer's Python, in the folder of its code, so it cannot import
splatgraft. Standard input has one JSON object per line:

    {"program": "inference_svd_rgbx.py", "arguments": ["--config", ...]}

For each, one line is written to standard output: {"error": null}, or {"error": "ValueError: ..."}. The programs' own
output goes to standard error. In the programs' modules, classes that load models are replaced by wrappers that return
the last model again if the arguments are equal.
"""

import importlib.util
import json
import os
import sys

LOADERS = (
    "RGBXVideoDiffusionPipeline",
    "UNetCustomSpatioTemporalConditionModel",
    "AutoencoderKLTemporalDecoder",
    "EnvEncoder",
    "CLIPVisionModelWithProjection",
    "CLIPImageProcessor",
)
"""Names of classes in the programs whose from_pretrained loads weights."""


class Kept:
    """Wrapper of a class that keeps the last object of its from_pretrained."""

    def __init__(self, kind):
        """Wrap the class `kind`."""
        self._kind, self._key, self._made = kind, None, None

    def __call__(self, *values, **named):
        """Construct an object of the class."""
        return self._kind(*values, **named)

    def from_pretrained(self, *values, **named):
        """Load a model, or return the last one if the arguments are equal."""
        key = [_identity(value) for value in values], {name: _identity(value) for name, value in named.items()}
        if key != self._key:
            self._key = self._made = None  # frees the memory of the last model before the next is loaded
            self._made = self._kind.from_pretrained(*values, **named)
            self._key = key
        return self._made

    def __getattr__(self, name):
        return getattr(self._kind, name)


def _identity(value):
    return value if isinstance(value, (str, int, float, bool, type(None))) else id(value)


def load(program):
    """Import a program as a module, and wrap its classes that load models."""
    name = os.path.splitext(os.path.basename(program))[0]
    spec = importlib.util.spec_from_file_location(name, program)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    for kind in LOADERS:
        if hasattr(module, kind):
            setattr(module, kind, Kept(getattr(module, kind)))
    return module


def run(module, job):
    """Run a program's main with the job's command line."""
    sys.argv = [job["program"], *job["arguments"]]
    module.main()


def main():
    """Do the jobs of standard input until it ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.path.insert(0, os.getcwd())
    modules = {}
    for line in sys.stdin:
        job, error = json.loads(line), None
        try:
            if job["program"] not in modules:
                modules[job["program"]] = load(job["program"])
            run(modules[job["program"]], job)
        except KeyboardInterrupt:
            break
        except SystemExit as stopped:
            error = f"exit status {stopped.code}" if stopped.code else None
        except Exception as failure:
            error = f"{type(failure).__name__}: {failure}"
        answers.write(json.dumps({"error": error}) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
