"""The commands `weights list`, `weights fetch` and `weights verify`."""
