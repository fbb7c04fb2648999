"""Uploads from a browser: written to the disk as they arrive, continued where they were interrupted, then checked."""
