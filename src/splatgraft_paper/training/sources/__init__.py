"""Sources of training pairs, and the generation of those that are not rendered."""
