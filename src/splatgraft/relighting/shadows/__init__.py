"""Visibility of light: samples of a light, shadow maps, occlusion, and the Gaussians that receive shadows."""
