"""The compact harmoniser: a small network that takes the view, its geometry and the light transfer's result."""
