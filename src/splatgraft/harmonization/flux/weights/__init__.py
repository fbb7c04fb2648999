"""Weights of the FLUX harmoniser: model folders, downloads, low-rank adaptations, precision, text embeddings."""
