"""Pages to look at: planes of volumes in the radiological display, and measured against re-projected X-rays.

Display: axial and coronal planes show the patient's right on the left of the page; sagittal planes show anterior on
the left; anterior is up in axial planes and superior in the others. HU window [-1000, 400] in grey. Values that are
not finite are shown in magenta.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from phydict.grid import Grid
from phydict.runtime.files import atomic_write
from phydict.xray.residuals import misfits

DISPLAY = (-1000.0, 400.0)
"""HU shown as black and as white."""

DIFFERENCE = 500.0
"""HU of error shown in full blue (too low) and full red (too high), and of deviation in the brightest colour."""

PLANES = {"axial": (2, "RLAP"), "coronal": (1, "RLSI"), "sagittal": (0, "APSI")}
"""Plane -> the axis across it, and the letters on the left, right, top and bottom edge."""

MOST_VIEWS = 8

STRETCH = 15.0
"""An X-ray's longer side over its shorter one, above which it is shown stretched to this, to be seen at all."""

GREY = colormaps["gray"].with_extremes(bad="magenta")
SPREAD = colormaps["inferno"].with_extremes(bad="magenta")
SIGNED = colormaps["RdBu_r"].with_extremes(bad="magenta")


def plane(volume, grid: Grid, name: str) -> tuple[np.ndarray, float]:
    """The plane `name` (axial, coronal, sagittal) through the centre of `volume`, rows from the top of the page.

    volume: (X, Y, Z), array or tensor, leading axes of size 1 allowed; it is turned to RAS+ by the grid's affine first.
    Returns the 2-D image and the height of its pixels over their width.
    Raises ValueError when the volume does not have the grid's shape.
    """
    axis, _ = PLANES[name]
    array = _array(volume, 3, "a volume")
    if array.shape != grid.shape:
        raise ValueError(f"the volume has shape {array.shape}, but its grid has {grid.shape}; "
                         "pass the volume's own grid")
    turn = nib.io_orientation(grid.affine)
    array = nib.apply_orientation(array, turn)
    spacing = np.empty(3)
    spacing[turn[:, 0].astype(int)] = grid.spacing
    across, up = [n for n in range(3) if n != axis]
    image = array.take(array.shape[axis] // 2, axis)[::-1, ::-1].T
    return image, float(spacing[up] / spacing[across])


def panel(path: str | Path, reconstruction_hu, grid: Grid, xrays=None, reprojection=None, truth_hu=None,
          title: str = "", deviation_hu=None, deviation_label: str = "standard deviation", pixel: float = 1.0) -> None:
    """Write one PNG page of a case: three planes, beside the truth and the difference, and its X-rays below.

    deviation_hu: (X, Y, Z), how uncertain each voxel is, shown beside them from black to yellow under its label.

    reconstruction_hu, truth_hu: (X, Y, Z) in HU. xrays, reprojection: (K, V, U) line integrals, measured and of the
    reconstruction; up to 8 views, evenly picked, all in one scale. The misfit ||A x - y|| / ||y|| of each view stands
    above its residual. pixel: the height of their pixels over their width. Leading axes of size 1 are allowed
    everywhere; values may be NaN.
    Raises ValueError on unequal shapes, or on a re-projection without measured X-rays.
    """
    if reprojection is not None and xrays is None:
        raise ValueError("a re-projection is shown against measured X-rays; pass xrays as well")
    volumes = {"reconstruction": reconstruction_hu} | ({} if truth_hu is None else {"truth": truth_hu})
    beside = truth_hu is not None or deviation_hu is not None
    rows = 3 if beside else 1
    columns = 1 + 2 * (truth_hu is not None) + (deviation_hu is not None) if beside else 3
    planes_height, xrays_height = 3.6 * rows, 0.0 if xrays is None else (1.9 if reprojection is None else 5.6)
    figure, upper, lower = _page(4.0 * max(columns, 3), planes_height, xrays_height, title)
    cells = upper.add_gridspec(rows, columns, wspace=0.08, hspace=0.14, **_margins(planes_height, 0.3))
    for n, name in enumerate(PLANES):
        for column, (label, volume) in enumerate(volumes.items()):
            ax = upper.add_subplot(cells[n, column] if beside else cells[0, n])
            _show_plane(ax, volume, grid, name, f"{label}, {name}")
        if deviation_hu is not None:
            _show_image(upper.add_subplot(cells[n, columns - 1]), deviation_hu, grid, name,
                        f"{deviation_label}, up to {DIFFERENCE:g} HU", SPREAD, 0, DIFFERENCE)
        if truth_hu is not None:
            difference = _array(reconstruction_hu, 3, "a volume") - _array(truth_hu, 3, "a volume")
            _show_image(upper.add_subplot(cells[n, 2]), difference, grid, name,
                        f"difference, ±{DIFFERENCE:g} HU", SIGNED, -DIFFERENCE, DIFFERENCE)
    if xrays is not None:
        _show_xrays(lower, xrays_height, xrays, reprojection, pixel)
    _save(figure, path)


def method_panel(path: str | Path, volumes: Mapping[str, object], truth_hu, grid: Grid,
                 captions: Mapping[str, str] | None = None, title: str = "") -> None:
    """Write one PNG page that compares methods side by side, in the coronal and the axial plane.

    volumes: method -> (X, Y, Z) in HU. truth_hu: the same, shown first, or None. captions: method -> a line to print
    under its name, such as "24.1 dB, SSIM 0.81".
    Raises ValueError without volumes, or on a caption of an unknown method.
    """
    captions = dict(captions or {})
    if not volumes:
        raise ValueError("there are no volumes to compare; pass {method: volume in HU}")
    if unknown := captions.keys() - volumes.keys():
        raise ValueError(f"captions name the methods {sorted(unknown)}, but the volumes are of {list(volumes)}")
    shown = ([] if truth_hu is None else [("truth", truth_hu)]) + list(volumes.items())
    height = 6.2
    figure, page, _ = _page(max(3.0 * len(shown), 6.0), height, 0.0, title)
    cells = page.add_gridspec(2, len(shown), wspace=0.05, hspace=0.05, **_margins(height, 0.5))
    for column, (name, volume) in enumerate(shown):
        for row, which in enumerate(("coronal", "axial")):
            heading = f"{name}\n{captions.get(name, '')}" if row == 0 else ""
            _show_plane(page.add_subplot(cells[row, column]), volume, grid, which, heading)
    _save(figure, path)


def _page(width: float, upper: float, lower: float, title: str):
    """A figure of `width` inches with a strip for a title and subfigures of these heights (the lower may be None)."""
    strip = 0.45 if title else 0.05
    figure = Figure(figsize=(width, strip + upper + lower), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    heights = [strip, upper] + ([lower] if lower else [])
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights, hspace=0)
    parts[0].suptitle(literal(title), fontsize=13, y=0.6, va="center")
    return figure, parts[1], parts[2] if lower else None


def literal(text: str) -> str:
    """A text that Matplotlib shows as it is, whatever dollars are in it."""
    return text.replace("$", "\\$")


def _margins(height: float, heading: float) -> dict[str, float]:
    return {"left": 0.02, "right": 0.98, "bottom": 0.1 / height, "top": 1 - heading / height}


def _show_image(ax: Axes, volume, grid: Grid, name: str, heading: str, colours: Colormap, low: float,
                high: float) -> np.ndarray:
    """Shows the plane `name` of a volume in colours from low to high; returns its pixels."""
    image, aspect = plane(volume, grid, name)
    ax.imshow(np.ma.masked_invalid(image), colours, aspect=aspect, vmin=low, vmax=high, interpolation="nearest")
    _finish(ax, heading)
    return image


def _show_plane(ax: Axes, volume, grid: Grid, name: str, heading: str) -> None:
    image = _show_image(ax, volume, grid, name, heading, GREY, *DISPLAY)
    for (x, y), letter in zip(((0.03, 0.5), (0.97, 0.5), (0.5, 0.96), (0.5, 0.04)), PLANES[name][1]):
        _write(ax, x, y, letter, "center")
    if broken := int((~np.isfinite(image)).sum()):
        _write(ax, 0.02, 0.04, f"{broken} not finite", "left")


def _write(ax: Axes, x: float, y: float, text: str, align: str) -> None:
    outline = [withStroke(linewidth=2, foreground="black")]
    ax.text(x, y, text, transform=ax.transAxes, color="gold", fontsize=8, ha=align, va="center", path_effects=outline)


def _show_xrays(figure, height: float, xrays, reprojection, pixel: float) -> None:
    measured = _array(xrays, 3, "a set of X-rays")
    rows = {"measured": measured}
    if reprojection is not None:
        rendered = _array(reprojection, 3, "a set of X-rays")
        if rendered.shape != measured.shape:
            raise ValueError(f"the re-projection has shape {rendered.shape}, but the X-rays have {measured.shape}")
        rows |= {"re-projected": rendered, "residual": rendered - measured}
        per_view = misfits(torch.from_numpy(rendered), torch.from_numpy(measured))["misfit_per_view"]
    count = min(len(measured), MOST_VIEWS)
    views = np.linspace(0, len(measured) - 1, count).round().astype(int)
    low, high = _scale(np.concatenate([rows[name][views].ravel() for name in rows if name != "residual"]))
    spread = np.abs(_scale(rows["residual"][views])).max() if "residual" in rows else 0.0
    cells = figure.add_gridspec(len(rows), 1, hspace=0.22, left=0.045, right=0.93, bottom=0.1 / height,
                                top=1 - 0.3 / height)
    headings = {"measured": [f"view {view} of {len(measured)}" for view in views]}
    if "residual" in rows:
        headings["residual"] = [f"misfit {per_view[view]:.3g}" for view in views]
    tall, wide = measured.shape[1:]
    aspect = np.clip(pixel * tall / wide, 1 / STRETCH, STRETCH) * wide / tall
    gap = max(1, round(0.06 * wide))
    starts = (wide + gap) * np.arange(MOST_VIEWS)
    width = starts[-1] + wide
    for row, (name, images) in enumerate(rows.items()):
        limits, colours = ((-spread, spread), SIGNED) if name == "residual" else ((low, high), GREY)
        mapped = ScalarMappable(Normalize(*limits), colours)
        strip = np.ones((tall, width, 4))
        for start, view in zip(starts, views):
            strip[:, start:start + wide] = mapped.cmap(mapped.norm(np.ma.masked_invalid(images[view])))
        ax = figure.add_subplot(cells[row, 0])
        ax.imshow(strip, aspect=aspect, interpolation="nearest")
        _finish(ax, "")
        ax.set_ylabel(name, fontsize=9)
        for start, heading in zip(starts, headings.get(name, [])):
            ax.annotate(heading, ((start + wide / 2) / width, 1), (0, 3), "axes fraction", "offset points", fontsize=9,
                        ha="center")
        bar = ax.inset_axes(((starts[count - 1] + wide) / width + 0.017, 0, 0.0135, 1))
        figure.colorbar(mapped, cax=bar).ax.tick_params(labelsize=7)


def _scale(values: np.ndarray) -> tuple[float, float]:
    """The range that holds the finite values but for the extreme 0.5 %; never empty."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, (0.25, 99.75))
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def _finish(ax: Axes, heading: str) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)
    if heading:
        ax.set_title(heading, fontsize=9, pad=3)


def _array(values, dimensions: int, noun: str) -> np.ndarray:
    """A float array of the wanted number of dimensions; leading axes of size 1 are dropped."""
    if hasattr(values, "detach"):
        values = values.detach().float().cpu().numpy()
    array = np.asarray(values, dtype=np.float32)
    while array.ndim > dimensions and len(array) == 1:
        array = array[0]
    if array.ndim != dimensions:
        raise ValueError(f"{noun} to show has {dimensions} axes, but shape {array.shape} was given; pass one case")
    return array


def _save(figure: Figure, path: str | Path) -> None:
    with atomic_write(Path(path)) as part:
        figure.savefig(part, format="png")
