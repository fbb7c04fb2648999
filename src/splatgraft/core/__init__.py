"""Values: frozen dataclasses of tensors (Gaussians, cameras, images, transforms) and pure functions on them."""
