"""Training of image models on pairs of composites and targets."""
