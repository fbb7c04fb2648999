"""Runs DiffusionRenderer's own programs again and again in one process, with its models loaded once.

Started by `relighters.py` with DiffusionRenderer's Python, in the folder of its code: nothing of this package
can be imported here. Standard input has one JSON object per line:

    {"program": "inference_svd_rgbx.py", "arguments": ["--config", ...]}

and standard output gets one line for each: {"error": null}, or {"error": "ValueError: ..."}. What the programs print
goes to standard error. The classes that load models are replaced in the programs' modules by ones that keep the last
object they made, so that a program that is called with the same weights and size finds them loaded.
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
"""Names in the programs whose from_pretrained loads weights."""


class Kept:
    """Stands for a class; what its from_pretrained made last is given again for equal arguments."""

    def __init__(self, kind):
        """Keep what `from_pretrained` makes."""
        self._kind, self._key, self._made = kind, None, None

    def __call__(self, *values, **named):
        """Construct."""
        return self._kind(*values, **named)

    def from_pretrained(self, *values, **named):
        """Load, or give what was loaded last."""
        key = [_identity(value) for value in values], {name: _identity(value) for name, value in named.items()}
        if key != self._key:
            self._key = self._made = None  # the memory of the last one, before the next is loaded
            self._made = self._kind.from_pretrained(*values, **named)
            self._key = key
        return self._made

    def __getattr__(self, name):
        return getattr(self._kind, name)


def _identity(value):
    return value if isinstance(value, (str, int, float, bool, type(None))) else id(value)


def load(program):
    """The module of a program, its loading classes replaced."""
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
    """Call a program as its command line would."""
    sys.argv = [job["program"], *job["arguments"]]
    module.main()


def main():
    """Do the jobs of the standard input until it ends."""
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
