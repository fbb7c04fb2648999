"""Runs of the benchmark: scenes are composed, methods applied to them, and their pictures measured."""
