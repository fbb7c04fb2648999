"""Rendering of Gaussians (3D Gaussian Splatting): one interface, numba kernels on the CPU, gsplat on CUDA."""

from splatgraft.rendering.interface import (
    Output,
    Render,
    RenderOptions,
    ViewOperator,
    render,
    surface_points,
    view_operator,
)

__all__ = ["Output", "Render", "RenderOptions", "ViewOperator", "render", "surface_points", "view_operator"]
