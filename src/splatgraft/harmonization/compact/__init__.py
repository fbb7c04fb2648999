"""The compact harmoniser: a small network that is given the geometry and the light transfer's opinion.

Imported only when asked for; knows no scene and no training.
"""
