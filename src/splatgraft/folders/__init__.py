"""Folders and files that several steps share: composites, rendered views, masks."""
