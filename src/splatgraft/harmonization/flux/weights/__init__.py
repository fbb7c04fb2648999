"""Weights of the FLUX harmoniser: folders, headers, adapters, precision, and text embeddings."""
