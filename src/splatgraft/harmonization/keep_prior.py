"""The harmoniser `none`: what the light transfer made is what is kept. Looks at no pixel."""

from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs


class KeepPrior:
    """Gives the prior back unchanged."""

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The very tensor `view.prior`."""
        return Harmonized(image=view.prior)
