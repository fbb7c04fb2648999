"""Synthetic scenes with ground truth, rendered with Blender: training pairs and the benchmark."""
