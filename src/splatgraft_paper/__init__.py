"""Experiments of the paper: synthetic data, training, methods by others, the benchmark and the tables.

This package imports splatgraft; splatgraft never imports it. Its commands are `splatgraft paper ...`.
"""
