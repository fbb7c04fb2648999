"""The harmoniser `none`: returns the light transfer's result unchanged."""

from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs


class IdentityHarmonizer:
    """Returns the prior unchanged."""

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Return the tensor `view.prior` itself."""
        return Harmonized(image=view.prior)
