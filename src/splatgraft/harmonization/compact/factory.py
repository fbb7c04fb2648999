"""Factory of the harmoniser `compact`; heavy modules are imported when it is called."""

from pathlib import Path

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import CompactOptions, HarmonizerContext

SHIPPED = Path(__file__).parent / "compact.safetensors"


def make_compact(options: CompactOptions, context: HarmonizerContext) -> Harmonizer:
    """Load the compact network.

    Raises:
        ValueError: The weights are missing or of another network, or the strength is out of range.
    """
    from splatgraft.harmonization.compact.harmonizer import Compact
    from splatgraft.harmonization.compact.weights import read_weights

    if not 0 <= options.strength <= 1:
        raise ValueError(f"--strength: expected a number from 0 to 1, found {options.strength}")
    path = SHIPPED if options.weights is None else Path(options.weights)
    network = read_weights(path / SHIPPED.name if path.is_dir() else path)
    return Compact(network, device=context.device, strength=options.strength)
