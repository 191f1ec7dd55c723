"""The page of a dry run: where sources, detectors and the volume are, and each X-ray beside that of a standard thorax.

The axial plan is seen from the feet, with the patient's right on the left of the page and anterior up; the coronal
elevation is seen from the front. Sources are numbered dots, detectors thick lines, central rays thin ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from phydict.evaluation.gallery import DISPLAY, GREY, MOST_VIEWS, PLANES, plane
from phydict.grid import Grid
from phydict.inference.orientation import LEAST, better_flip, correlation
from phydict.runtime.files import atomic_write, is_signed
from phydict.xray import ConeBeam

SIDES = (("right", "left"), ("anterior", "posterior"), ("superior", "inferior"))
DRAWN = {"axial": 1, "coronal": 2}
"""Planes of the geometry -> the world axis that runs up the page; across it run the patient's right and left."""

SIGNED = "phydict's page of a geometry"
"""What the file of a page says wrote it, so that none but a page is ever replaced."""


def body_side(direction) -> str:
    """The side of the body that a world direction (3,) points to: one word, or several where it lies between sides."""
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    parts = [(abs(value), names[int(value < 0)]) for value, names in zip(direction, SIDES)]
    return " ".join(name for size, name in sorted(parts, reverse=True) if size > np.sin(np.pi / 8))


def view_sides(beam: ConeBeam, grid: Grid) -> list[str]:
    """Per view, which body side faces the source and which way the image's columns and rows run."""
    return [f"source {body_side(source - grid.centre)}, columns to {body_side(u)}, rows to {body_side(v)}"
            for source, u, v in zip(beam.sources, beam.u, beam.v)]


def agreement(xray: np.ndarray, thorax: np.ndarray, flips: bool = True) -> str:
    """How well a view (V, U) correlates with the standard thorax's, and what clearly agrees better, if anything: the
    image inverted or, if `flips` count, a flip."""
    stated, (flip, score) = correlation(xray, thorax), better_flip(xray, thorax)
    label = f"agreement {stated:.2f}"
    if -stated > max(LEAST, score):
        return f"{label}, better ({-stated:.2f}) inverted"
    return f"{label}, better ({score:.2f}) with {flip} changed" if flips and flip != "as it is" else label


def geometry_page(path: str | Path, beam: ConeBeam, grid: Grid, xrays: np.ndarray, thorax: np.ndarray,
                  thorax_hu: np.ndarray, title: str = "", flips: bool = True) -> None:
    """Write the page as PNG: the geometry, and up to 8 views, evenly picked.

    xrays: (K, V, U) the measured images; thorax: (K, V, U) the standard thorax's in the same beam; thorax_hu: its HU
    (X, Y, Z) on `grid`, shown where it lies; flips: whether flips that agree better are named, as in `agreement`.
    Raises ValueError where the images do not have the beam's shape, or where what is at `path` is no such page.
    """
    for images in (xrays, thorax):
        if images.shape != (beam.views, *beam.shape):
            raise ValueError(f"images of shape {images.shape} were given for a beam of {(beam.views, *beam.shape)}; "
                             "give the images of this beam")
    if Path(path).exists() and not is_signed(Path(path), SIGNED):
        raise ValueError(f"{path} is there already, is no page of this kind, and is not replaced: move it away, or "
                         "give another place")
    shown = np.linspace(0, beam.views - 1, min(beam.views, MOST_VIEWS)).round().astype(int)
    figure = Figure(figsize=(max(2.1 * len(shown), 12.0), 12.6), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    upper, lower = figure.subfigures(2, 1, height_ratios=[7, 5.6], hspace=0)  # type: ignore[misc]
    upper.suptitle(title, fontsize=13, parse_math=False)
    for ax, (name, axis) in zip(upper.subplots(1, 2), DRAWN.items()):
        _draw(ax, beam, grid, thorax_hu, name, axis)
    sides = view_sides(beam, grid)
    cells = lower.subplots(2, len(shown), squeeze=False, gridspec_kw={
        "left": 0.05, "right": 0.98, "bottom": 0.08, "top": 0.84, "wspace": 0.1, "hspace": 0.08})
    for (top, bottom), k in zip(cells.T, shown):
        top.set_title(f"view {k}\n" + sides[k].replace(", ", "\n"), fontsize=8, pad=3)
        for ax, image in ((top, xrays[k]), (bottom, thorax[k])):
            ax.imshow(image, "gray", interpolation="nearest", aspect=float(beam.pixel[k, 0] / beam.pixel[k, 1]))
            ax.set(xticks=[], yticks=[])
        words = agreement(xrays[k], thorax[k], flips).replace(", ", ",\n").replace(" with ", "\nwith ")
        bottom.set_xlabel(words, fontsize=8)
    cells[0, 0].set_ylabel("your X-rays", fontsize=9)
    cells[1, 0].set_ylabel("a standard thorax", fontsize=9)
    with atomic_write(Path(path)) as part:
        figure.savefig(part, format="png", metadata={"Software": SIGNED})


def _draw(ax: Axes, beam: ConeBeam, grid: Grid, thorax_hu: np.ndarray, name: str, axis: int) -> None:
    """One plane of the geometry around the thorax in its box of voxels."""
    axes = [0, axis]
    (left, low), (right, high) = grid.corners()[:, axes].min(0), grid.corners()[:, axes].max(0)
    ax.imshow(plane(thorax_hu, grid, name)[0], GREY, vmin=DISPLAY[0], vmax=DISPLAY[1], extent=(right, left, low, high))
    rows, columns = beam.shape
    for k in range(beam.views):
        colour = f"C{k % 10}"
        corners = [beam.detectors[k] + i * columns / 2 * beam.u[k] + j * rows / 2 * beam.v[k]
                   for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
        ax.plot(*np.array(corners)[:, axes].T, color=colour, linewidth=2)
        ax.plot(*np.array([beam.sources[k], beam.detectors[k]])[:, axes].T, color=colour, linewidth=0.5)
        ax.plot(*beam.sources[k, axes], "o", color=colour, markersize=5)
        ax.annotate(str(k), tuple(beam.sources[k, axes]), xytext=(5, 5), textcoords="offset points", fontsize=8)
    every = np.concatenate([beam.pixels()[:, ::max(rows - 1, 1), ::max(columns - 1, 1)].reshape(-1, 3), beam.sources,
                            grid.corners()])[:, axes]
    margin = 0.1 * np.ptp(every, axis=0).max()  # where the letters stand
    (left, low), (right, high) = every.min(0) - margin, every.max(0) + margin
    ax.set(xlim=(right, left), ylim=(low, high), aspect="equal", xlabel="mm", ylabel="mm", title=name)
    ax.tick_params(labelsize=7)
    letters = PLANES[name][1]
    for x, y, letter in ((0.02, 0.5, letters[0]), (0.98, 0.5, letters[1]), (0.5, 0.98, letters[2]),
                         (0.5, 0.02, letters[3])):
        ax.text(x, y, letter, transform=ax.transAxes, ha="center", va="center", fontsize=11, fontweight="bold")
