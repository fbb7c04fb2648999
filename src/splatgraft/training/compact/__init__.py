"""Training of the compact harmoniser: data, deliberately wrong priors, losses, loop. Knows no command line."""
