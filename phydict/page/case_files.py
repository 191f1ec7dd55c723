"""What the page shows of a case and the browser cannot read itself: its volumes and X-rays as text, and a thumbnail."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path

import nibabel as nib
import numpy as np
from PIL import Image
from torch import Tensor

from phydict.evaluation.gallery import DISPLAY, binned, fitted, plane
from phydict.grid import Grid
from phydict.runtime.files import atomic_write

VIEW, THUMBNAIL = "view.js", "thumbnail.png"
CASE_FILES = (VIEW, THUMBNAIL)
"""The files of a case that only the page needs."""

NO_VALUE = -2**15
"""The int16 of a voxel that is not finite."""

XRAY_SIDE = 256
"""Pixels along an X-ray's longer side, above which it is shown binned."""

THUMBNAIL_SIDE = 96


def write_case_files(folder: Path, grid: Grid, volumes: Mapping[str, Tensor | np.ndarray],
                     xrays: Tensor | None = None, reprojection: Tensor | None = None,
                     names: Collection[str] = CASE_FILES, pixel: float = 1.0) -> None:
    """Writes what the page shows of a case into its folder, of `names` alone.

    volumes: name -> HU (X, Y, Z) on `grid`, "reconstruction" first, then "truth" where it is known and how uncertain a
    voxel is, by any other name; kept as int16 in RAS+, rounded. xrays, reprojection: line integrals (K, V, U), kept as
    uint16 over the range of both; None where they are not known. pixel: the height of their pixels over their width.
    """
    if THUMBNAIL in names:
        _write_thumbnail(folder / THUMBNAIL, next(iter(volumes.values())), grid)
    if VIEW not in names:
        return
    turn = nib.io_orientation(grid.affine)
    affine = grid.affine @ nib.orientations.inv_ornt_aff(turn, grid.shape)
    with atomic_write(folder / VIEW) as part, part.open("w", encoding="ascii") as file:
        file.write('phydictView({"volumes": {')
        for n, (name, volume) in enumerate(volumes.items()):
            turned = nib.apply_orientation(_int16(volume), turn)
            file.write(f'{", " * (n > 0)}{json.dumps(name)}: "{packed(turned.ravel(order="F"))}"')
        file.write("},\n")
        if xrays is not None and reprojection is not None:
            file.write(f'"X-rays": {json.dumps(_xrays(np.asarray(xrays), np.asarray(reprojection), pixel))},\n')
        file.write(f'"shape": {list(turned.shape)}, "affine": {affine[:3].tolist()}, '
                   f'"inverse": {np.linalg.inv(affine)[:3].tolist()}}});\n')


def packed(array: np.ndarray) -> str:
    """An array's little-endian bytes, compressed by gzip, in base64."""
    squeeze = zlib.compressobj(1, wbits=31)
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return base64.b64encode(squeeze.compress(little.data) + squeeze.flush()).decode()


def _int16(volume: Tensor | np.ndarray) -> np.ndarray:
    hu = np.asarray(volume)
    out = np.empty(hu.shape, np.int16)
    for x, values in enumerate(hu):  # slice by slice, so that a large volume needs no second copy in float
        whole = np.where(np.isfinite(values), np.rint(values).clip(NO_VALUE + 1, -NO_VALUE - 1), NO_VALUE)
        out[x] = whole
    return out


def _xrays(measured: np.ndarray, rendered: np.ndarray, pixel: float) -> dict:
    factor = -(-max(measured.shape[1:]) // XRAY_SIDE)
    rows, columns = (min(factor, size) for size in measured.shape[1:])
    images = [binned(values, rows, columns) for values in (measured, rendered)]
    finite = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    step = (high - low or 1.0) / (2**16 - 1)
    codes = [packed(np.rint((np.nan_to_num(image, nan=low, posinf=high, neginf=low) - low) / step).astype(np.uint16))
             for image in images]
    return {"shape": images[0].shape, "pixel": pixel * rows / columns, "low": low, "step": step, "measured": codes[0],
            "rendered": codes[1]}


def _write_thumbnail(path: Path, volume: Tensor | np.ndarray, grid: Grid) -> None:
    """The middle coronal plane in the gallery's window as a small PNG."""
    image, aspect = plane(volume, grid, "coronal")
    low, high = DISPLAY
    grey = np.nan_to_num((image - low) / (high - low)).clip(0, 1) * 255
    size = fitted(image.shape[0] * aspect / image.shape[1], THUMBNAIL_SIDE, THUMBNAIL_SIDE)
    with atomic_write(path) as part:
        Image.fromarray(grey.astype(np.uint8)).resize(size, Image.Resampling.BILINEAR).save(part, format="png")
