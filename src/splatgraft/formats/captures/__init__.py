"""Captures on disk: cameras, photographs, masks and sparse points; one module per format."""
