"""A learned correction of the estimated light at a place."""
