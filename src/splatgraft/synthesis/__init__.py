"""Synthetic ground truth: scenes from a seed, training pairs and benchmark scenes rendered with Blender Cycles."""
