"""The held-out benchmark of the light transfer, `paper exam`."""
