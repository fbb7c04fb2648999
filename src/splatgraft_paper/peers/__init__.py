"""Harmonisers by other authors, for comparison: LBM, IC-Light, MV-CoLight and an image-editing service."""
