"""Training of the compact harmoniser: pairs, light-transfer priors under perturbed lights, losses and loop."""
