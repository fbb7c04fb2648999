"""Infrastructure without domain knowledge: atomic files and folders, worker pools, memoising, settings, console."""
