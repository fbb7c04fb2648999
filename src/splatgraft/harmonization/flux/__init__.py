"""The paper's harmoniser (Sec. 5): FLUX.1-schnell conditioned on the composite and the object's mask."""
