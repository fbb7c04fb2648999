"""Reading and writing of the folders and files that several steps share: composites, rendered views, masks."""
