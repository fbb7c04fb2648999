"""Factory of the harmoniser `flux`; heavy modules are imported when it is called."""

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import FluxOptions, HarmonizerContext

AUTHORS_LINE = "nviolante/dot3d/image-mask"


def make_flux(options: FluxOptions, context: HarmonizerContext) -> Harmonizer:
    """Load the paper's image model.

    Raises:
        ValueError: No weights are named, they do not fit, or an option is out of range.
    """
    from splatgraft.harmonization.flux.harmonizer import FluxHarmonizer, FluxSettings
    from splatgraft.harmonization.flux.weights.loading import FluxWeights, load_flux

    if options.weights is None:
        raise ValueError(
            f"harmonizer flux: expected --weights FOLDER or a hub id such as {AUTHORS_LINE} (24 GB, by the paper's "
            "authors under their own licence), found none"
        )
    for name in ("strength", "detail"):
        if not 0 <= getattr(options, name) <= 1:
            raise ValueError(f"--{name}: expected a number from 0 to 1, found {getattr(options, name)}")
    wanted = FluxWeights(
        weights=options.weights,
        base=options.base,
        lora=options.lora,
        variant=options.variant,
        precision=options.precision,
        compiled=options.compile,
        steps=options.sampling_steps,
        strengths=context.strengths,
    )
    network = load_flux(wanted, context.device, say=context.say, pixels=context.pixels, views=options.batch)
    settings = FluxSettings(
        seed=options.seed,
        steps=options.sampling_steps,
        strength=options.strength,
        detail=options.detail,
        at_once=options.batch,
    )
    return FluxHarmonizer(network, settings)
