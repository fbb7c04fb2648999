"""A project on disk: its files, the folders of its results, what makes them stale, and how a step replaces one."""
