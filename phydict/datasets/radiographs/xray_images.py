"""One X-ray image per file: PNG, TIFF, NPY and NIfTI with their stored pixel type; which files are DICOM."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from phydict.datasets.natural_order import has_signs, natural_order
from phydict.datasets.nifti_file import NIFTI, open_nifti
from phydict.runtime.reading import MOST_SQUEEZED, check_held, read_npy, reading, refusing

DICOM = (".dcm", ".dicom", ".ima")
ENDINGS = (".png", ".tif", ".tiff", ".npy", *NIFTI, *DICOM)
GREY = ("L", "I;16", "I;16B", "I;16L", "I", "F")
CUT = "16-bit colour would be cut to 8 bit; store it as 16-bit grey"
UNKNOWN = ("it is no PNG or TIFF of a kind that is read: of 8 or 16 bits, or TIFF of 32-bit integers or 32-bit "
           "floating-point numbers; store such a one, or NPY")
SWAPPED = ("it is a compressed TIFF of big-endian numbers, whose bytes would be swapped; store it as little-endian, or "
           "uncompressed")

BITS, PHOTOMETRIC, FORMAT = 258, 262, 339
"""Tags of a TIFF: the bits of each channel, what is 0 where its least value is shown white, and what is 1, or left out,
where numbers have no sign."""


def image_files(folder: Path) -> list[Path]:
    """The X-ray images of a folder in the natural order of their names; DICOM files need no ending."""
    images = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")
              and (p.name.lower().endswith(ENDINGS) or is_dicom(p))]
    signed = has_signs([p.name for p in images])
    return sorted(images, key=lambda p: natural_order(p.name, signed))


def is_dicom(path: Path) -> bool:
    """Whether a file's name or its first bytes say that it is DICOM."""
    if path.name == "DICOMDIR":  # the index of a disc
        return False
    if path.name.lower().endswith(DICOM):
        return True
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def read_image(path: Path) -> np.ndarray:
    """One image (V, U) with its stored pixel type.

    Raises ValueError naming the file where it cannot be read, is not one grey image, or holds values that are not
    finite numbers.
    """
    with refusing(path, "export it again"):
        return _checked(_read_image(path), path)


def _read_image(path: Path) -> np.ndarray:
    name = path.name.lower()
    with reading(f"the image {path}", "export it again"):
        if name.endswith(".npy"):
            return read_npy(path)
        if name.endswith(NIFTI):
            return _read_nifti(path)
        return _read_picture(path)


def _checked(image: np.ndarray, path: Path) -> np.ndarray:
    """The image, one grey value per pixel. Raises ValueError."""
    if image.ndim == 3 and image.shape[0] == 1:
        image = image[0]
    if image.ndim != 2:
        raise ValueError(f"{path} has shape {image.shape}; give one 2D image per view")
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise ValueError(f"{path} holds pixels of type {image.dtype}; give integers or floating-point numbers")
    bad = image.size - int(np.isfinite(image).sum())
    if bad:
        raise ValueError(f"{path} holds {bad} NaN or infinite pixels; give finite values everywhere")
    return image


def _read_nifti(path: Path) -> np.ndarray:
    """An image (U, V) with any number of axes of length 1 beside, as (V, U); other shapes without such axes."""
    image = np.asarray(open_nifti(path).dataobj)
    for axis in reversed(range(image.ndim)):
        if image.ndim > 2 and image.shape[axis] == 1:
            image = image.squeeze(axis)
    return image.T if image.ndim == 2 else image


def _read_picture(path: Path) -> np.ndarray:
    """A grey PNG or TIFF; colours are allowed where all channels are equal."""
    header = path.read_bytes()[:26]
    if header[1:4] == b"PNG" and len(header) == 26 and header[24] == 16 and header[25] != 0:
        raise ValueError(CUT)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            opened = Image.open(path)
        except UnidentifiedImageError:
            raise ValueError(UNKNOWN) from None
    with opened as image:
        if (pages := getattr(image, "n_frames", 1)) > 1:
            raise ValueError(f"it holds {pages} pages; store one image per file")
        check_held(math.prod(image.size), path, f"pixels, {image.height} x {image.width},", 8 * MOST_SQUEEZED)
        tags = getattr(image, "tag_v2", {})
        if image.mode not in GREY and max(tags.get(BITS, (8,))) > 8:
            raise ValueError(CUT)
        swapped = getattr(tags, "prefix", b"") == b"MM" and image.info.get("compression") != "raw"
        if swapped and image.mode in ("I", "F"):
            raise ValueError(SWAPPED)
        image.filename = ""  # by it Pillow would map the file, and cut the rows of turned TIFFs wrongly
        image.load()
        if image.mode in GREY:
            pixels = np.asarray(image)
            sixteen = image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG")
            pixels = pixels.astype(np.uint16) if sixteen else pixels
            if image.mode == "I" and tags.get(BITS) == (32,) and tags.get(FORMAT, (1,)) == (1,):
                pixels = pixels.view(np.uint32)
            white = sixteen and image.format == "TIFF" and image.getexif().get(PHOTOMETRIC) == 0
            return 65535 - pixels if white else pixels  # of 8 bits PIL does it
        pixels = np.asarray(image.convert("RGBA"))
    if (pixels[..., 3] != 255).any():
        raise ValueError("it is partly transparent; store it as grey without transparency")
    if (pixels[..., :1] != pixels[..., :3]).any():
        raise ValueError("its colour channels differ; store it as grey")
    return pixels[..., 0]
