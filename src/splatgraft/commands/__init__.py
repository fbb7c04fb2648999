"""The command line's commands: one file per command; the steps of the flow are in `steps/`."""
