"""Benchmark measurements: per-view metrics, statistics of image sets, tables, and published data sets."""
