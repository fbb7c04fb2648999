"""Where training pairs come from, one file each, and what makes those that are not rendered. Knows no network."""
