"""Shadows: light samples, shadow maps, soft occlusion, and the Gaussians that receive shadows."""
