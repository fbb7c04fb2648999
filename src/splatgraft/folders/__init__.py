"""Reading and writing the result folders that several steps share: composites, rendered views, masks."""
