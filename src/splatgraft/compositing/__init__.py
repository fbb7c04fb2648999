"""Composites: a target scene with placed objects, merged into one scene of Gaussians."""
