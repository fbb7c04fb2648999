"""The paper's harmoniser (Sec. 4): FLUX.1-schnell conditioned on the composite and the object's mask."""
