"""Synthetic scenes with ground truth, rendered by Blender: training pairs and the benchmark."""
