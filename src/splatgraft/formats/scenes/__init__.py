"""Gaussian scene files: one module per format."""
