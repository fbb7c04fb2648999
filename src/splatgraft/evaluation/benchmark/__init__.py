"""Measurements over benchmark scenes: per-view metrics, tables, image statistics, published data sets."""
