"""Runs of the benchmark: scenes made ready, methods applied to them, and their pictures measured."""
