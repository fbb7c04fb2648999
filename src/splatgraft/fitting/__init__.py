"""Fitting of Gaussians to images: optimisation loop, density control, sparse Adam and losses."""

from splatgraft.fitting.photometric import l1_dssim

__all__ = ["l1_dssim"]
