"""The commands `train ...`, one file each: training of image models on pairs."""
