"""Harmonisers by other authors and a baseline, for the paper's comparison."""
