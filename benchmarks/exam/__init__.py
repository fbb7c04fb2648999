"""An exam of the light transfer on synthetic scenes that nobody has seen, drawn from a number; see `command.py`."""
