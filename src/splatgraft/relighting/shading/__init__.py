"""Shading of Gaussians: normals, irradiance, reflections, and ratios between two lights."""
