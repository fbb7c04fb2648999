"""The paper's harmoniser: FLUX.1-schnell given the composite and the mask. Knows nothing about scenes."""
