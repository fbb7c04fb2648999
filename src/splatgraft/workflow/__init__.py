"""The steps of a project as a graph, with time estimates, background jobs and the benchmark's runs."""
