"""Infrastructure: atomic files and folders, worker pools, child processes, memoising, settings, console."""
