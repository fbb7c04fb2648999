"""The steps of a project as a graph: their order, stale results, time estimates and runs."""
