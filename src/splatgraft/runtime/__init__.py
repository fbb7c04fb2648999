"""Infrastructure: files, processes, workers, kernels, settings, progress, notes and the console."""
