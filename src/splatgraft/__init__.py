"""splatgraft: move an object from one 3D Gaussian Splatting capture into another and make the light agree."""

__version__ = "0.1.0"
