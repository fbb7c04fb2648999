"""The commands `train ...`: image models trained on pairs."""
