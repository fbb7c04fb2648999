"""The commands of the command line, one file each; the steps of a project are in `steps/`."""
