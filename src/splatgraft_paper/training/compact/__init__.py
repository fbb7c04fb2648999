"""Training of the compact harmoniser: pairs, light-transfer priors under perturbed lights, loss and task."""
