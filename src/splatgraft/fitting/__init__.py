"""What fits of Gaussians to images share: image losses, and a sparse Adam."""

from splatgraft.fitting.photometric import l1_dssim

__all__ = ["l1_dssim"]
