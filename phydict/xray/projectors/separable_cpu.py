"""Compiled CPU loops of the separable projector, without tables; phydict.xray.projectors.separable explains the
operator.

Columns of pixels go in groups of LANES. On each depth plane the group's in-plane interpolation gives one axial line
per column; the lines are laid side by side, so that the axial interpolation runs along the group. The adjoint runs
the same loops backwards. `project` passes over voxel columns and end slices that are all zero. Each pixel of `project`
and each axial slab of `backproject` has one writer, so no result depends on the number of threads.

Arrays that the inner loops touch are flat with unsigned indices: only then are the loops vectorised.
"""

from __future__ import annotations

import numpy as np
from numba import prange, uint64

from phydict.xray.projectors.compiled import compiled

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""Liberties of the compiler: order of sums and fused products, but NaN and infinity are kept."""

LANES = 32
"""Columns of pixels that one pass carries."""


@compiled(fastmath=FAST, parallel=True)
def project(volumes, xrays, starts, columns, rows, planes):
    """Fills xrays (B, K, V, U) with the projections of volumes (B, X, Y, Z).

    The rays are those of phydict.xray.projectors.separable.Rays.
    """
    cases, views, _height, width = xrays.shape
    groups = (width + LANES - 1) // LANES
    filled = np.zeros((cases, volumes.shape[1] + 1, volumes.shape[2] + 1), np.bool_)
    extents = np.empty((cases, 2), np.int64)
    for case in range(cases):
        _find_filled(volumes[case], filled[case], extents[case])
    for task in prange(cases * views * groups):
        case, rest = task // (views * groups), task % (views * groups)
        view, first = rest // groups, rest % groups * LANES
        _project_group(volumes[case], xrays[case, view], first, filled[case].reshape(-1), extents[case], starts[view],
                       columns[view], rows[view], planes[view])


@compiled(fastmath=FAST, parallel=True)
def backproject(volumes, xrays, slabs, starts, columns, rows, planes):
    """Adds the adjoint of xrays (B, K, V, U) to volumes (B, X, Y, Z), in so many axial slabs at once."""
    cases, views = xrays.shape[:2]
    nz = volumes.shape[3]
    everywhere = np.ones((volumes.shape[1] + 1) * (volumes.shape[2] + 1), np.bool_)
    for task in prange(cases * slabs):
        case, slab = task // slabs, task % slabs
        low, high = slab * nz // slabs, (slab + 1) * nz // slabs
        for view in range(views):
            _backproject_slab(volumes[case], xrays[case, view], low, high, everywhere, starts[view], columns[view],
                              rows[view], planes[view])


@compiled()
def _find_filled(volume, filled, extent):
    """Mark the cells (X + 1, Y + 1) between voxel columns that have a column with values among their four corners,
    and find the slices extent[0] <= z < extent[1] that hold all values."""
    nx, ny, nz = volume.shape
    low, high = nz, 0
    for i in range(nx):
        for j in range(ny):
            line = volume[i, j]
            first = 0
            while first < nz and line[first] == 0:
                first += 1
            if first == nz:
                continue
            last = nz
            while line[last - 1] == 0:
                last -= 1
            low, high = min(low, first), max(high, last)
            filled[i:i + 2, j:j + 2] = True
    extent[0], extent[1] = min(low, high), high


@compiled(fastmath=FAST)
def _hits(start, columns, far, shape, first, lanes, filled, cells, weights):
    """Where a group's rays cross a depth plane: cells (lanes) counts the voxel column of the lower neighbours in a
    plane padded by one voxel, -1 where the ray misses or the cell is not `filled`; weights (4, lanes). Returns whether
    any ray hits."""
    nx, ny = shape[0], shape[1]
    hit = False
    for c in range(lanes):
        x, y = start[0] + columns[first + c, 0] * far, start[1] + columns[first + c, 1] * far
        cells[c] = -1
        i, j = int(x + 1), int(y + 1)
        if -1 < x < nx and -1 < y < ny and filled[i * (ny + 1) + j]:
            hit = True
            fx, fy = x + 1 - i, y + 1 - j
            cells[c] = i * (ny + 1) + j
            weights[0, c], weights[1, c] = (1 - fx) * (1 - fy), (1 - fx) * fy
            weights[2, c], weights[3, c] = fx * (1 - fy), fx * fy
    return hit


@compiled(fastmath=FAST)
def _rows_within(start, rows, far, low, high):
    """The rows of pixels [first, last) whose rays may pass between the axial indices low and high at a plane."""
    count = len(rows)
    begin, pace = start[2] + rows[0, 0] * far, 0.0
    if count > 1:
        pace = (rows[count - 1, 0] - rows[0, 0]) / (count - 1) * far
    if pace == 0.0:
        return 0, count
    one, two = (low - begin) / pace, (high - begin) / pace
    return max(0, int(min(one, two)) - 1), min(count, max(0, int(max(one, two)) + 3))


@compiled(fastmath=FAST)
def _project_group(volume, image, first, filled, extent, start, columns, rows, planes):
    nx, ny, nz = volume.shape
    low, high = extent[0], extent[1]
    thick = high - low
    height, lanes = image.shape[0], min(LANES, image.shape[1] - first)
    flat = volume.reshape(-1)
    cells, weights = np.empty(LANES, np.int64), np.empty((4, LANES), volume.dtype)
    line = np.empty(thick, volume.dtype)
    lines = np.zeros((thick + 2) * LANES, volume.dtype)
    sums = np.zeros(height * LANES, volume.dtype)
    for d in range(int(planes[2])):
        far = planes[0] + d * planes[1]
        if not _hits(start, columns, far, volume.shape, first, lanes, filled, cells, weights):
            continue
        for c in range(lanes):
            i, j = cells[c] // (ny + 1) - 1, cells[c] % (ny + 1) - 1
            if cells[c] < 0:
                line[:] = 0
            elif 0 <= i < nx - 1 and 0 <= j < ny - 1:
                p = uint64((i * ny + j) * nz + low)
                q, r, s = p + uint64(nz), p + uint64(ny * nz), p + uint64((ny + 1) * nz)
                v, w, x, y = weights[0, c], weights[1, c], weights[2, c], weights[3, c]
                for z in range(uint64(thick)):
                    line[z] = v * flat[p + z] + w * flat[q + z] + x * flat[r + z] + y * flat[s + z]
            else:
                line[:] = 0
                for corner in range(4):
                    a, b = i + corner // 2, j + corner % 2
                    if 0 <= a < nx and 0 <= b < ny:
                        p, w = uint64((a * ny + b) * nz + low), weights[corner, c]
                        for z in range(uint64(thick)):
                            line[z] += w * flat[p + z]
            for z in range(thick):
                lines[(z + 1) * LANES + c] = line[z]
        top, bottom = _rows_within(start, rows, far, low - 1, high)
        for v in range(top, bottom):
            at = start[2] + rows[v, 0] * far + 1 - low
            if 0 < at < thick + 1:
                k = int(at)
                f = volume.dtype.type(at - k)
                here, row = uint64(k * LANES), uint64(v * LANES)
                for lane in range(LANES):
                    c = uint64(lane)  # type: ignore[assignment]
                    value = lines[here + c]
                    sums[row + c] += value + f * (lines[here + c + uint64(LANES)] - value)
    for v in range(height):
        for c in range(lanes):
            image[v, first + c] = sums[v * LANES + c] * _length(columns[first + c], rows[v], planes[1])


@compiled(fastmath=FAST)
def _backproject_slab(volume, image, low, high, everywhere, start, columns, rows, planes):
    nx, ny, nz = volume.shape
    thick = high - low
    height, width = image.shape
    flat = volume.reshape(-1)
    cells, weights = np.empty(LANES, np.int64), np.empty((4, LANES), volume.dtype)
    line = np.empty(thick, volume.dtype)
    lines = np.empty((thick + 2) * LANES, volume.dtype)
    values = np.empty(height * LANES, volume.dtype)
    for first in range(0, width, LANES):
        lanes = min(LANES, width - first)
        values[:] = 0
        for v in range(height):
            for c in range(lanes):
                values[v * LANES + c] = image[v, first + c] * _length(columns[first + c], rows[v], planes[1])
        for d in range(int(planes[2])):
            far = planes[0] + d * planes[1]
            if not _hits(start, columns, far, volume.shape, first, lanes, everywhere, cells, weights):
                continue
            lines[:] = 0
            top, bottom = _rows_within(start, rows, far, low - 1, high)
            for v in range(top, bottom):
                at = start[2] + rows[v, 0] * far + 1 - low
                if 0 < at < thick + 1:
                    k = int(at)
                    f = volume.dtype.type(at - k)
                    here, row = uint64(k * LANES), uint64(v * LANES)
                    for lane in range(LANES):
                        c = uint64(lane)  # type: ignore[assignment]
                        above = f * values[row + c]
                        lines[here + c] += values[row + c] - above
                        lines[here + c + uint64(LANES)] += above
            for c in range(lanes):
                if cells[c] < 0:
                    continue
                for z in range(thick):
                    line[z] = lines[(z + 1) * LANES + c]
                i, j = cells[c] // (ny + 1) - 1, cells[c] % (ny + 1) - 1
                for corner in range(4):
                    a, b = i + corner // 2, j + corner % 2
                    if 0 <= a < nx and 0 <= b < ny:
                        p, w = uint64((a * ny + b) * nz + low), weights[corner, c]
                        for z in range(uint64(thick)):
                            flat[p + z] += w * line[z]


@compiled(fastmath=FAST)
def _length(column, row, step):
    """mm of a pixel's ray from plane to plane: the same fraction of its length as of the way to the detector."""
    return step * np.sqrt(column[2] + row[1] * row[1])
