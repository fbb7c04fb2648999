"""Rendering on the CPU: numba kernels for projection, tile lists and blending, as torch autograd functions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import cpu_blend, cpu_depth, cpu_frozen, cpu_project, cpu_tiles
from splatgraft.rendering.interface import CHANNEL_COUNTS, Output, Render, RenderOptions, assemble_render
from splatgraft.runtime.kernels import KERNEL_LOCK

_DEPTHS: frozenset[Output] = frozenset({"depth", "inverse_depth"})


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    outputs: frozenset[Output],
    features: Float[Tensor, "n f"] | None,
    options: RenderOptions,
) -> Render:
    """Render as `rendering.render` does, for tensors on the CPU."""
    extra = gaussians.means.new_zeros(gaussians.count, 0) if features is None else features
    fields = [t.float() for t in (*_geometry(gaussians), gaussians.sh, extra)]
    views = [_RenderView.apply(_View.of(camera, options), outputs, *fields) for camera in cameras]
    image, alpha, depth, visible = (_stack(parts) for parts in zip(*views, strict=True))
    return assemble_render(image, alpha, depth, visible, outputs=outputs, options=options)


def _stack(parts: tuple[Tensor, ...]) -> Tensor:
    # torch.stack copies even a single tensor
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _geometry(gaussians: Gaussians) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), dtype=np.float32)


@dataclass(frozen=True)
class _View:
    """One camera and the low-pass mode as arguments of the kernels."""

    numbers: np.ndarray
    width: int
    height: int
    antialiased: bool

    @staticmethod
    def of(camera: Cameras, options: RenderOptions) -> "_View":
        width, height = camera.width, camera.height
        pose = camera.camera_from_world[0].detach().double().numpy()
        k = camera.intrinsics[0].detach().double().numpy()
        fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
        # the original's 1.3 times the field of view, for a principal point anywhere (as gsplat)
        margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
        bounds = [-cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y]
        center = camera.centers[0].detach().double().numpy()
        numbers = [fx, fy, cx, cy, *bounds, options.near, width, height, options.low_pass_px2]
        parts = [pose[:3, :3].ravel(), pose[:3, 3], center, numbers]
        return _View(np.concatenate(parts), width, height, options.low_pass == "antialiased")


@dataclass(frozen=True)
class _TileLists:
    """The splats of one view, nearest first, and the tiles' lists of them."""

    count: int
    """Number n of the scene's Gaussians."""
    order: np.ndarray
    """(m,) index of each splat's Gaussian."""
    splats: np.ndarray
    """(m, 8) columns of `cpu_project`, in the order of `order`."""
    inverse_depths: np.ndarray
    """(m, 3) depth columns of `cpu_project`, in the order of `order`; empty if no depth was requested."""
    start: np.ndarray
    """(tiles + 1,) begin of each tile's list in `entries`."""
    entries: np.ndarray
    """(e,) index of the splat, tile after tile."""
    slots: np.ndarray
    """(e,) row of each entry's sums; the rows of one splat are adjacent."""
    first: np.ndarray
    """(m + 1,) begin of each splat's slots."""
    rows: np.ndarray
    """(e, 2) uint8, first and one past the last row of the tile that counts; empty if all rows of the splat count."""

    @staticmethod
    def of(view: _View, geometry: Sequence[np.ndarray], *, with_depth: bool = False) -> "_TileLists":
        count = len(geometry[0])
        splats, depths = np.empty((count, cpu_project.COLUMNS), np.float32), np.zeros(count, np.float32)
        inverse_depths = np.empty((count if with_depth else 0, cpu_project.DEPTH_COLUMNS), np.float32)
        cpu_project.project(*geometry, view.numbers, view.antialiased, splats, depths, inverse_depths)
        order = cpu_tiles.depth_order(splats, depths)
        packed, start, entries, slots, first = cpu_tiles.bin_splats(splats, order, view.width, view.height)
        packed_depths = np.empty((len(order) if with_depth else 0, cpu_project.DEPTH_COLUMNS), np.float32)
        cpu_blend.gather(inverse_depths, order[: len(packed_depths)], packed_depths)
        rows = np.empty((0, 2), np.uint8)
        return _TileLists(count, order, packed, packed_depths, start, entries, slots, first, rows)

    @cached_property
    def drawn(self) -> np.ndarray:
        """(n,) whether some tile lists the Gaussian."""
        out = np.zeros(self.count, np.bool_)
        out[self.order[np.diff(self.first) > 0]] = True
        return out

    def without_hidden(self, view: _View, min_row_weight: float) -> "_TileLists":
        """Keep only entries with rows of more weight than the bound, and of each the rows from the first to the last.

        With the bound 0 the lists, rendered to their ends, give the same image.
        """
        rows = np.empty((len(self.entries), 2), np.uint8)
        size = view.height, view.width
        cpu_frozen.find_rows(self.splats, self.start, self.entries, size, np.float32(min_row_weight), rows)
        listed = rows[:, 1] > 0
        shown = np.empty_like(listed)
        shown[self.slots] = listed
        shown_before, listed_before = (np.concatenate([[0], np.cumsum(x)]).astype(np.int32) for x in (shown, listed))
        first = shown_before[self.first]
        kept = first[1:] > first[:-1]
        place = (np.cumsum(kept) - 1).astype(np.int32)
        return _TileLists(
            count=self.count,
            order=self.order[kept],
            splats=self.splats[kept],
            inverse_depths=self.inverse_depths,
            start=listed_before[self.start],
            entries=place[self.entries[listed]],
            slots=shown_before[self.slots[listed]],
            first=np.concatenate([first[:1], first[1:][kept]]),
            rows=rows[listed],
        )

    def in_order(self, values: np.ndarray) -> np.ndarray:
        """Gather the rows of `values (n, c)` of the splats, (m, c)."""
        out = np.empty((len(self.order), values.shape[1]), np.float32)
        cpu_blend.gather(values, self.order, out)
        return out

    def blend(self, values: np.ndarray, view: _View, least: np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Blend `values (n, c)` to (c, h, w); gives alpha (h, w), too."""
        image = np.empty((values.shape[1], view.height, view.width), np.float32)
        alpha = np.empty((view.height, view.width), np.float32)
        cpu_blend.blend(self.splats, self.start, self.entries, self.rows, self.in_order(values), image, alpha, least)
        return image, alpha

    def blend_with_inverse_depth(self, colors: np.ndarray, view: _View) -> tuple[np.ndarray, np.ndarray]:
        """Blend `colors (n, 3)` and inverse depth to (4, h, w); gives alpha (h, w), too."""
        image = np.empty((cpu_depth.CHANNELS, view.height, view.width), np.float32)
        alpha = np.empty((view.height, view.width), np.float32)
        cpu_depth.blend(
            self.splats, self.start, self.entries, self.in_order(colors), self.inverse_depths,
            image, alpha, cpu_blend.MIN_TRANSMITTANCE,
        )  # fmt: skip
        return image, alpha

    def median_depth(self, view: _View) -> np.ndarray:
        """Compute the median depth (h, w)."""
        depth = np.empty((view.height, view.width), np.float32)
        cpu_depth.median_depth(self.splats, self.start, self.entries, self.inverse_depths, depth)
        return depth

    def blend_transpose(self, image: np.ndarray, least: np.float32) -> np.ndarray:
        """Compute for every slot the sum over pixels of weight times `image (c, h, w)`, (e, c)."""
        sums = np.empty((len(self.entries), len(image)), np.float32)
        cpu_blend.blend_transpose(self.splats, self.start, self.entries, self.rows, self.slots, image, sums, least)
        return sums

    def sum_slots(self, sums: np.ndarray) -> np.ndarray:
        """Add up sums of entries (e, c) per Gaussian (n, c)."""
        out = np.zeros((self.count, sums.shape[1]), np.float32)
        cpu_blend.sum_slots(sums, self.first, self.order, out)
        return out


class _RenderView(torch.autograd.Function):
    """Autograd function from raw fields and features to the blended channels (c, h, w) of one view.

    The channels are in the order of `CHANNEL_COUNTS`. It also gives alpha (h, w), the median depth (h, w; empty if not
    requested), and whether each Gaussian is visible (n,).
    """

    @staticmethod
    def forward(ctx, view: _View, outputs: frozenset[Output], *fields: Tensor):
        means, log_scales, quaternions, logits, sh, features = (_array(field) for field in fields)
        with KERNEL_LOCK:
            lists = _TileLists.of(
                view, (means, log_scales, quaternions, logits), with_depth=not outputs.isdisjoint(_DEPTHS)
            )
            columns = []
            if "color" in outputs:
                columns.append(np.empty((len(means), 3), np.float32))
                cpu_project.shade(means, sh, lists.drawn, view.numbers, columns[-1])
            if "normal" in outputs:
                columns.append(np.empty((len(means), 3), np.float32))
                cpu_project.normals(means, log_scales, quaternions, lists.drawn, view.numbers, columns[-1])
            values = np.concatenate([*columns, features], 1)
            if "inverse_depth" in outputs:
                image, alpha = lists.blend_with_inverse_depth(values, view)
            else:
                image, alpha = lists.blend(values, view, cpu_blend.MIN_TRANSMITTANCE)
            depth = lists.median_depth(view) if "depth" in outputs else np.empty((0, 0), np.float32)
        ctx.view, ctx.outputs, ctx.lists = view, outputs, lists
        ctx.save_for_backward(*fields)
        ctx.blended = values, image, alpha
        visible, depth = torch.from_numpy(lists.drawn), torch.from_numpy(depth)
        ctx.mark_non_differentiable(depth, visible)
        return torch.from_numpy(image), torch.from_numpy(alpha), depth, visible

    @staticmethod
    def backward(ctx, grad_image, grad_alpha, _grad_depth, _grad_visible):
        means, log_scales, quaternions, logits, sh, _ = (_array(field) for field in ctx.saved_tensors)
        view, lists, (values, image, alpha) = ctx.view, ctx.lists, ctx.blended
        grads = [np.zeros(field.shape, np.float32) for field in ctx.saved_tensors]
        grad_means, grad_log_scales, grad_quaternions, grad_logits, grad_sh, _ = grads
        # columns of the sums: one per value, and for inverse depth the columns of a splat
        widths = CHANNEL_COUNTS | {"inverse_depth": cpu_project.DEPTH_COLUMNS}
        places, at = {}, cpu_blend.MOMENTS
        for name in CHANNEL_COUNTS:
            if name in ctx.outputs:
                places[name], at = at, at + widths[name]
        inverse_depths = (lists.inverse_depths,) if "inverse_depth" in places else ()
        kernel = cpu_depth.blend_backward if inverse_depths else cpu_blend.blend_backward
        with KERNEL_LOCK:
            sums = np.empty((len(lists.entries), at + ctx.saved_tensors[-1].shape[1]), np.float32)
            kernel(
                lists.splats, lists.start, lists.entries, lists.slots, lists.in_order(values), *inverse_depths,
                image, alpha, _array(grad_image), _array(grad_alpha), sums, cpu_blend.MIN_TRANSMITTANCE,
            )  # fmt: skip
            totals = lists.sum_slots(sums)
            if "color" in places:
                cpu_project.shade_backward(
                    means, sh, lists.drawn, view.numbers, totals, places["color"], grad_means, grad_sh
                )
            cpu_project.project_backward(
                means, log_scales, quaternions, logits, lists.drawn, view.numbers, view.antialiased,
                totals, places.get("inverse_depth", 0), places.get("normal", 0),
                grad_means, grad_log_scales, grad_quaternions, grad_logits,
            )  # fmt: skip
        grads[-1] = totals[:, at:]
        return None, None, *(torch.from_numpy(grad) for grad in grads)


class FrozenView:
    """`ViewOperator` on the CPU: tile lists of visible splats, made once and always rendered to their ends."""

    def __init__(self, gaussians: Gaussians, camera: Cameras, options: RenderOptions, min_row_weight: float) -> None:
        """Project, sort, make tile lists, and drop hidden splats and rows."""
        self._view = _View.of(camera, options)
        with KERNEL_LOCK:
            lists = _TileLists.of(self._view, [_array(t) for t in _geometry(gaussians)])
            self._lists = lists.without_hidden(self._view, min_row_weight)
        self.visible = torch.from_numpy(self._lists.drawn)

    @cached_property
    def alpha(self) -> Float[Tensor, "h w"]:
        """Accumulated opacity in [0, 1], computed on first use."""
        with KERNEL_LOCK:
            nothing = np.empty((self._lists.count, 0), np.float32)
            return torch.from_numpy(self._lists.blend(nothing, self._view, cpu_blend.ALL)[1])

    def blend(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """W values, over black; differentiable in `values`."""
        return _Blend.apply(self._lists, self._view, values)

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """W^T image."""
        return _transpose(self._lists, image)

    def blend_and_transpose(self, values: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """W^T W values."""
        lists, view = self._lists, self._view
        sums = np.empty((len(lists.entries), values.shape[1]), np.float32)
        with KERNEL_LOCK:
            cpu_frozen.blend_and_transpose(
                lists.splats, lists.start, lists.entries, lists.rows, lists.slots,
                lists.in_order(_array(values)), (view.height, view.width), sums,
            )  # fmt: skip
            return torch.from_numpy(lists.sum_slots(sums))

    def transpose_residual(self, values: Float[Tensor, "n"], target: Float[Tensor, "h w"]) -> Float[Tensor, "n"]:
        """W^T (target - W values)."""
        lists = self._lists
        sums = np.empty((len(lists.entries), 1), np.float32)
        with KERNEL_LOCK:
            cpu_frozen.transpose_residual(
                lists.splats, lists.start, lists.entries, lists.rows, lists.slots,
                lists.in_order(_array(values)[:, None])[:, 0], _array(target), sums,
            )  # fmt: skip
            return torch.from_numpy(lists.sum_slots(sums)[:, 0])


def _transpose(lists: _TileLists, image: Tensor) -> Tensor:
    with KERNEL_LOCK:
        return torch.from_numpy(lists.sum_slots(lists.blend_transpose(_array(image.permute(2, 0, 1)), cpu_blend.ALL)))


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, lists: _TileLists, view: _View, values: Tensor) -> Tensor:
        ctx.lists = lists
        with KERNEL_LOCK:
            image, _ = lists.blend(_array(values), view, cpu_blend.ALL)
        return torch.from_numpy(image).permute(1, 2, 0)

    @staticmethod
    def backward(ctx, grad):
        return None, None, _transpose(ctx.lists, grad)
