"""Makes the harmoniser `compact` from options. Imports nothing heavy before it is called."""

from pathlib import Path

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import HarmonizerOptions

SHIPPED = Path(__file__).parent / "compact.safetensors"


def make_compact(options: HarmonizerOptions) -> Harmonizer:
    """With the weights named (a file, or the folder of a training), else those that are shipped.

    Raises: ValueError where there are none, they are of something else, or the strength is none.
    """
    from splatgraft.harmonization.compact.harmonizer import Compact
    from splatgraft.harmonization.compact.weights import read_weights

    if not 0 <= options.strength <= 1:
        raise ValueError(f"--strength: expected a number from 0 to 1, found {options.strength}")
    path = SHIPPED if options.weights is None else Path(options.weights)
    network = read_weights(path / SHIPPED.name if path.is_dir() else path)
    return Compact(network, device=options.device, strength=options.strength)
