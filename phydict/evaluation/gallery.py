"""Pages to look at: planes of volumes in the radiological display, and measured against re-projected X-rays.

Display: axial and coronal planes show the patient's right on the left of the page; sagittal planes show anterior on
the left; anterior is up in axial planes and superior in the others. HU window [-1000, 400] in grey. Values that are
not finite are shown in magenta.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import matplotlib
import nibabel as nib
import numpy as np
import torch
from matplotlib.colors import Colormap, Normalize
from PIL import Image, ImageDraw, ImageFont

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

GREY = matplotlib.colormaps["gray"].with_extremes(bad="magenta")
SPREAD = matplotlib.colormaps["inferno"].with_extremes(bad="magenta")
SIGNED = matplotlib.colormaps["RdBu_r"].with_extremes(bad="magenta")

FONT = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"

TITLE, HEADING, LINE = 44, 26, 16
"""Pixels from above that a page's title takes, that a heading takes, and each line of it."""

CELL, METHOD_CELL, GAP = (430, 370), (320, 320), 10
"""Pixels across and down that a plane has in a case's page and in one of several methods, and those between two."""

XRAY_HEIGHT, XRAY_LEFT, XRAY_RIGHT = 170, 100, 90
"""Pixels down of a row of X-rays at most, and across those that the names of rows and the scales of colours take."""


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
    columns = [("reconstruction", reconstruction_hu, GREY, DISPLAY)]
    if truth_hu is not None:
        difference = _array(reconstruction_hu, 3, "a volume") - _array(truth_hu, 3, "a volume")
        columns += [("truth", truth_hu, GREY, DISPLAY),
                    (f"difference, ±{DIFFERENCE:g} HU", difference, SIGNED, (-DIFFERENCE, DIFFERENCE))]
    if deviation_hu is not None:
        columns.append((f"{deviation_label}, up to {DIFFERENCE:g} HU", deviation_hu, SPREAD, (0, DIFFERENCE)))
    cells = [(row, column) for row in PLANES for column in columns]
    wide = len(columns) if len(columns) > 1 else len(PLANES)  # planes lie beside each other where they are alone
    across, down = CELL[0] + GAP, CELL[1] + HEADING
    top = TITLE if title else GAP
    upper = top + len(cells) // wide * down
    width, shown = max(wide, len(PLANES)) * across + GAP, (0, 0)
    if xrays is not None:
        tall, broad = _array(xrays, 3, "a set of X-rays").shape[1:]
        shown = fitted(float(np.clip(pixel * tall / broad, 1 / STRETCH, STRETCH)),
                        (width - XRAY_LEFT - XRAY_RIGHT) // MOST_VIEWS - GAP, XRAY_HEIGHT)
    rows = 0 if xrays is None else 1 if reprojection is None else 3
    page, left = _Page(width, upper + rows * (shown[1] + HEADING) + GAP, title), (width - wide * across + GAP) // 2
    for n, (name, (label, volume, colours, limits)) in enumerate(cells):
        heading = f"{label}, {name}" if colours is GREY else label
        page.plane(volume, grid, name, heading, (left + n % wide * across, top + n // wide * down + HEADING), CELL,
                   colours, limits)
    if xrays is not None:
        _show_xrays(page, upper, shown, xrays, reprojection)
    page.save(path)


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
    (wide, high), top = METHOD_CELL, (TITLE if title else GAP) + HEADING + LINE
    page = _Page(max(len(shown), 2) * (wide + GAP) + GAP, top + 2 * (high + GAP), title)
    for column, (name, volume) in enumerate(shown):
        for row, which in enumerate(("coronal", "axial")):
            heading = f"{name}\n{captions.get(name, '')}" if row == 0 else ""
            page.plane(volume, grid, which, heading, (GAP + column * (wide + GAP), top + row * (high + GAP)),
                       METHOD_CELL, GREY, DISPLAY)
    page.save(path)


def binned(images: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Means of blocks of so many rows and columns of pixels (K, V, U); incomplete blocks at the far edges are left
    out."""
    views, high, wide = images.shape[0], images.shape[1] // rows, images.shape[2] // columns
    cut = images[:, :high * rows, :wide * columns].astype(np.float32)
    return cut.reshape(views, high, rows, wide, columns).mean((2, 4))


class _Page:
    """A white page with a title, on which pictures and words are put; places are (x, y) in pixels from the upper left.
    """

    def __init__(self, width: int, height: int, title: str):
        self.image = Image.new("RGB", (width, height), "white")
        self.pen = ImageDraw.Draw(self.image)
        self.words(title, (width // 2, TITLE // 2), width, size=18)

    def words(self, text: str, place: tuple[float, float], width: float, size: int = 13, anchor: str = "mm",
              outlined: bool = False) -> None:
        """Writes lines, smaller where they are wider than `width` pixels; anchor: Pillow's, of the place in them;
        outlined: in gold with a black outline, to be read on a picture."""
        needed = max((_font(size).getlength(line) for line in text.split("\n")), default=0)
        font = _font(max(min(size, int(size * width / needed)), 6) if needed else size)
        ink = {"fill": "gold", "stroke_width": 1, "stroke_fill": "black"} if outlined else {"fill": "black"}
        self.pen.text(place, text, font=font, anchor=anchor, align="center", spacing=2, **ink)

    def picture(self, values: np.ndarray, place: tuple[int, int], size: tuple[int, int], colours: Colormap,
                limits: tuple[float, float]) -> None:
        """Shows values (rows, columns) in colours over the limits, `size` pixels across and down."""
        shown = colours(Normalize(*limits)(np.ma.masked_invalid(values)), bytes=True)[..., :3]
        self.image.paste(Image.fromarray(shown).resize(size, Image.Resampling.NEAREST), place)

    def plane(self, volume, grid: Grid, name: str, heading: str, place: tuple[int, int], cell: tuple[int, int],
              colours: Colormap, limits: tuple[float, float]) -> None:
        """Shows the plane `name` of a volume in the middle of a cell, under its heading; in grey, with letters of the
        patient's sides."""
        image, aspect = plane(volume, grid, name)
        wide, high = fitted(image.shape[0] * aspect / image.shape[1], *cell)
        left, top = place[0] + (cell[0] - wide) // 2, place[1] + (cell[1] - high) // 2
        self.picture(image, (left, top), (wide, high), colours, limits)
        self.words(heading, (place[0] + cell[0] / 2, top - 4), cell[0], anchor="md")
        if colours is not GREY:
            return
        for (x, y), letter in zip(((0.03, 0.5), (0.97, 0.5), (0.5, 0.04), (0.5, 0.96)), PLANES[name][1]):
            self.words(letter, (left + x * wide, top + y * high), wide, 13, outlined=True)
        if broken := int((~np.isfinite(image)).sum()):
            self.words(f"{broken} not finite", (left + 0.02 * wide, top + 0.96 * high), 0.45 * wide, 11, "lm", True)

    def scale(self, place: tuple[int, int], height: int, colours: Colormap, limits: tuple[float, float]) -> None:
        """Shows which colours stand for which values."""
        x, y = place
        self.picture(np.linspace(limits[1], limits[0], height)[:, None], place, (12, height), colours, limits)
        for part in (0.0, 0.25, 0.5, 0.75, 1.0):
            value = limits[1] + part * (limits[0] - limits[1])
            self.words(f"{value:.2g}", (x + 17, y + part * height), XRAY_RIGHT - 50, 11, "lm")

    def save(self, path: str | Path) -> None:
        with atomic_write(Path(path)) as part:
            self.image.save(part, format="png", compress_level=2)  # 6, the default, takes twice the time for 5 % less


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(FONT, size, layout_engine=ImageFont.Layout.BASIC)


def fitted(ratio: float, width: int, height: int) -> tuple[int, int]:
    """The largest size (across, down) in pixels of this height over width in a box."""
    return max(round(min(width, height / ratio)), 1), max(round(min(height, width * ratio)), 1)


def _show_xrays(page: _Page, top: int, size: tuple[int, int], xrays, reprojection) -> None:
    """Shows rows of X-rays of `size` pixels across and down, the first `top` pixels from above."""
    measured = _array(xrays, 3, "a set of X-rays")
    rows = {"measured": measured}
    if reprojection is not None:
        rendered = _array(reprojection, 3, "a set of X-rays")
        if rendered.shape != measured.shape:
            raise ValueError(f"the re-projection has shape {rendered.shape}, but the X-rays have {measured.shape}")
        rows |= {"re-projected": rendered, "residual": rendered - measured}
        per_view = misfits(torch.from_numpy(rendered), torch.from_numpy(measured))["misfit_per_view"]
    views = np.linspace(0, len(measured) - 1, min(len(measured), MOST_VIEWS)).round().astype(int)
    headings = {"measured": [f"view {view} of {len(measured)}" for view in views]}
    if reprojection is not None:
        headings["residual"] = [f"misfit {per_view[view]:.3g}" for view in views]
    blocks = [max(pixels // shown, 1) for pixels, shown in zip(measured.shape[1:], reversed(size))]
    rows = {name: binned(images[views], *blocks) for name, images in rows.items()}
    limits = dict.fromkeys(rows, _scale(np.concatenate([rows[name].ravel() for name in rows if name != "residual"])))
    if "residual" in rows:
        spread = np.abs(_scale(rows["residual"])).max()
        limits["residual"] = (-spread, spread)
    for n, (name, images) in enumerate(rows.items()):
        y, colours = top + HEADING + n * (size[1] + HEADING), SIGNED if name == "residual" else GREY
        page.words(name, (XRAY_LEFT - GAP, y + size[1] / 2), XRAY_LEFT - 2 * GAP, anchor="rm")
        for k, image in enumerate(images):
            x = XRAY_LEFT + k * (size[0] + GAP)
            page.picture(image, (x, y), size, colours, limits[name])
            if name in headings:
                page.words(headings[name][k], (x + size[0] / 2, y - 4), size[0] + GAP, anchor="md")
        page.scale((XRAY_LEFT + len(images) * (size[0] + GAP), y), size[1], colours, limits[name])


def _scale(values: np.ndarray) -> tuple[float, float]:
    """The range that holds the finite values but for the extreme 0.5 %; never empty."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, (0.25, 99.75))
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


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
