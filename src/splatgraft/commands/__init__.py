"""The commands that are no steps of a project, one file each."""
