"""The experiments of the paper: synthetic data, training, methods by others, the benchmark and the tables.

It imports splatgraft; splatgraft never imports it. Its commands are `splatgraft paper ...`.
"""
