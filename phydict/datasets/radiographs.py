"""Measured X-rays as a Case: a folder of images with `geometry.yaml`, and optionally `report.txt`.

geometry.yaml holds the beam (ConeBeam's YAML, at the top level or under `beam:`) and may hold

    intensity: {kind: line_integrals, scale: 1.0, offset: 0.0}     y = scale * pixel + offset
    intensity: {kind: counts, air: 50000, floor: 0.5}              y = log(air / max(pixel, floor))
    intensity: {kind: display, bright_is_dense: true}              y = gain * display + offset, both unknown per view
    orientation: {flip_rows: false, flip_columns: false}           images stored upside down or mirrored

Images are PNG (8 or 16 bit, grey or with equal colour channels), NPY (V, U), or NIfTI (U, V), one per view, in the
natural order of their names: view_2 comes before view_10. Row 0 is superior once `orientation` has been applied.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np
import torch
import yaml
from PIL import Image

from phydict.datasets.natural_order import natural_order
from phydict.xray.geometry import ConeBeam

GEOMETRY, REPORT = "geometry.yaml", "report.txt"
ENDINGS = (".png", ".npy", ".nii", ".nii.gz")
KINDS = ("line_integrals", "counts", "display")
UNREADABLE = (OSError, EOFError, ValueError, SyntaxError, zlib.error, nibabel.filebasedimages.ImageFileError)


@dataclass(frozen=True)
class Intensity:
    """How pixel values become line integrals y; see the module's table. Raises ValueError for impossible values.

    kind: "line_integrals", "counts" or "display". scale, offset: of line_integrals. air: counts without a patient.
    floor: the smallest count believed, 1e-5 of `air` when left out. bright_is_dense: display only, must be given.
    """

    kind: str
    scale: float = 1.0
    offset: float = 0.0
    air: float | None = None
    floor: float | None = None
    bright_is_dense: bool | None = None

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"intensity kind {self.kind!r} is unknown; give one of {', '.join(KINDS)}")
        for name in ("scale", "offset", "air", "floor"):
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, value if value is None else float(value))
            except (TypeError, ValueError) as error:
                raise ValueError(f"intensity needs a number for {name}, but {value!r} was given") from error
        if self.kind == "counts" and not (self.air and self.air > 0):
            raise ValueError(f"counts need `air`, the positive count without a patient, but air={self.air} was given")
        if self.floor is not None and not self.floor > 0:
            raise ValueError(f"the floor of counts must be positive, but floor={self.floor} was given")
        if self.kind == "display" and not isinstance(self.bright_is_dense, bool):
            raise ValueError("display images need `bright_is_dense`: true where bone is bright, false where it is dark")

    def line_integrals(self, pixels: np.ndarray, full_scale: float) -> np.ndarray:
        """Line integrals of pixels (K, V, U); for display images values in [0, 1] that grow with density.

        full_scale: the largest value the image format can hold. Raises ValueError for negative counts.
        """
        if self.kind == "line_integrals":
            return self.scale * pixels + self.offset
        if self.kind == "counts":
            negative = int((pixels < 0).sum())
            if negative:
                raise ValueError(f"{negative} pixels hold negative counts; give counts, or another intensity kind")
            return np.log(self.air / np.maximum(pixels, self.floor or 1e-5 * self.air))
        return pixels / full_scale if self.bright_is_dense else 1 - pixels / full_scale


def find_xrays(path: str | Path) -> list[Path]:
    """The case folders at `path`: itself if it holds geometry.yaml or images, else its subfolders that do.

    Raises FileNotFoundError where there is none.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"there is no folder {path}; give a folder of X-rays, or a folder of such folders")
    if _is_case(path):
        return [path]
    found = sorted((p for p in path.iterdir() if p.is_dir() and _is_case(p)), key=lambda p: natural_order(p.name))
    if not found:
        raise FileNotFoundError(f"neither {path} nor its subfolders hold {GEOMETRY} or X-ray images "
                                f"({', '.join(ENDINGS)}); give a folder of X-ray images")
    return found


def load_xrays(folder: str | Path, geometry: str | Path | None = None, intensity: Intensity | None = None) -> dict:
    """The Case of one folder of X-rays.

    geometry: a YAML file used instead of the folder's own. intensity: used instead of the YAML's block. Without either,
    floating-point images are taken as line integrals, and integer images are refused.
    Returns {"id": folder name, "xrays": (K,V,U) float32, "beam": ConeBeam, "report": str, "display": bool}; with
    display True, the X-rays are display values whose gain and offset per view are unknown.
    Raises FileNotFoundError for a missing folder, geometry or images, ValueError for everything that does not fit.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}; give a folder of X-ray images with {GEOMETRY}")
    files = _images(folder)
    if not files:
        raise FileNotFoundError(f"{folder} holds no X-ray image; put one of {', '.join(ENDINGS)} per view there")
    source = folder / GEOMETRY if geometry is None else Path(geometry)
    beam, stated, flip_rows, flip_columns = _read_geometry(source)
    if len(files) != beam.views:
        raise ValueError(f"{folder} holds {len(files)} images, but {source} describes {beam.views} views; "
                         "give one image per view")
    images = [_read_image(file) for file in files]
    for file, image in zip(files, images):
        if image.shape != beam.shape:
            raise ValueError(f"{file} has {image.shape[0]} x {image.shape[1]} pixels (rows x columns), but {source} "
                             f"describes a detector of {beam.shape[0]} x {beam.shape[1]}; correct `shape` and `pixel`")
        bad = image.size - int(np.isfinite(image).sum())
        if bad:
            raise ValueError(f"{file} holds {bad} NaN or infinite pixels; give finite values everywhere")
    if len({image.dtype for image in images}) > 1:
        kinds = ", ".join(sorted({str(image.dtype) for image in images}))
        raise ValueError(f"the images of {folder} have different pixel types ({kinds}); store all views alike")
    integer = np.issubdtype(images[0].dtype, np.integer)
    intensity = intensity or stated
    if intensity is None and integer:
        raise ValueError(f"the images of {folder} hold {images[0].dtype} pixels and {source} has no `intensity:`; "
                         f"say what they mean: kind {', '.join(KINDS)}")
    pixels = np.stack(images).astype(np.float64)
    full_scale = float(np.iinfo(images[0].dtype).max) if integer else max(float(np.abs(pixels).max()), 1e-12)
    try:
        xrays = (intensity or Intensity("line_integrals")).line_integrals(pixels, full_scale)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    xrays = xrays[:, ::-1 if flip_rows else 1, ::-1 if flip_columns else 1]
    return {"id": folder.absolute().name, "xrays": torch.from_numpy(xrays.astype(np.float32)), "beam": beam,
            "report": _read_report(folder / REPORT),
            "display": intensity is not None and intensity.kind == "display"}


def save_xrays(folder: str | Path, xrays: torch.Tensor | np.ndarray, beam: ConeBeam, report: str = "",
               png: bool = False) -> None:
    """Write line integrals (K, V, U) as view_<k>.npy, or 16-bit PNG, with geometry.yaml and report.txt.

    `load_xrays` reads them back: NPY as float32 exactly, PNG to half a step of range / 65535.
    Raises ValueError where the X-rays do not fit the beam, FileExistsError where other images lie in the folder.
    """
    xrays = np.asarray(xrays, np.float32)
    if xrays.shape != (beam.views, *beam.shape):
        raise ValueError(f"X-rays of shape {xrays.shape} were given for a beam of (views, rows, columns) "
                         f"{(beam.views, *beam.shape)}; give the X-rays of this beam")
    if not np.isfinite(xrays).all():
        raise ValueError("the X-rays hold NaN or infinite values; give finite line integrals")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"view_{k}.{'png' if png else 'npy'}" for k in range(beam.views)]
    others = [file.name for file in _images(folder) if file.name not in names]
    if others:
        raise FileExistsError(f"{folder} already holds other images ({', '.join(others)}); give an empty folder")
    low, high = float(xrays.min()), float(xrays.max())
    scale = max(high - low, 1e-6) / 65535
    for name, image in zip(names, xrays):
        if png:
            levels = np.rint((image.astype(np.float64) - low) / scale).clip(0, 65535).astype(np.uint16)
            Image.fromarray(levels).save(folder / name)
        else:
            np.save(folder / name, image)
    intensity = {"kind": "line_integrals"} | ({"scale": scale, "offset": low} if png else {})
    content = {"beam": beam.to_dict(), "intensity": intensity,
               "orientation": {"flip_rows": False, "flip_columns": False}}
    (folder / GEOMETRY).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    if report:
        (folder / REPORT).write_text(report + "\n", encoding="utf-8")
    else:
        (folder / REPORT).unlink(missing_ok=True)


def _is_case(folder: Path) -> bool:
    return (folder / GEOMETRY).is_file() or bool(_images(folder))


def _images(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir()
             if p.is_file() and not p.name.startswith(".") and p.name.lower().endswith(ENDINGS))
    return sorted(found, key=lambda p: natural_order(p.name))


def _read_geometry(path: Path) -> tuple[ConeBeam, Intensity | None, bool, bool]:
    if not path.is_file():
        raise FileNotFoundError(f"there is no geometry file {path}; write one with `beam:` and `intensity:` beside the "
                                "images, or give geometry=")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold `beam:`, and may hold `intensity:` and `orientation:`")
    intensity, orientation = content.pop("intensity", None), content.pop("orientation", None) or {}
    if "beam" in content and len(content) > 1:
        unknown = ", ".join(repr(key) for key in content if key != "beam")
        raise ValueError(f"{path}: unknown key {unknown}; the keys are beam, intensity, orientation")
    try:
        beam = ConeBeam.from_dict(content.get("beam", content))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    for block, value, keys in (("intensity", intensity or {}, tuple(Intensity.__dataclass_fields__)),
                               ("orientation", orientation, ("flip_rows", "flip_columns"))):
        unknown = [repr(key) for key in value if key not in keys] if isinstance(value, dict) else [repr(value)]
        if unknown:
            raise ValueError(f"{path}: unknown {', '.join(unknown)} in `{block}:`; the keys are {', '.join(keys)}")
    flips = [orientation.get(name, False) for name in ("flip_rows", "flip_columns")]
    if not all(isinstance(flip, bool) for flip in flips):
        raise ValueError(f"{path}: flip_rows and flip_columns are true or false, but {flips} was given")
    try:
        return beam, Intensity(**intensity) if intensity else None, *flips
    except TypeError as error:
        raise ValueError(f"{path}: `intensity:` needs `kind`, one of {', '.join(KINDS)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read_report(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip() if path.is_file() else ""
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text ({error}); save it as UTF-8") from error


def _read_image(path: Path) -> np.ndarray:
    """One image (V, U) with its stored pixel type."""
    name = path.name.lower()
    try:
        if name.endswith(".npy"):
            image = np.load(path, allow_pickle=False)
        elif name.endswith(".png"):
            image = _read_png(path)
        else:
            image = np.asarray(nibabel.load(path).dataobj)
            image = image.reshape(image.shape[:2]).T if image.size == np.prod(image.shape[:2]) else image
    except UNREADABLE as error:
        raise ValueError(f"the image {path} cannot be read ({error}); export it again") from error
    if image.ndim == 3 and image.shape[0] == 1:
        image = image[0]
    if image.ndim != 2:
        raise ValueError(f"{path} has shape {image.shape}; give one 2D image per view")
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise ValueError(f"{path} holds pixels of type {image.dtype}; give integers or floating-point numbers")
    return image


def _read_png(path: Path) -> np.ndarray:
    header = path.read_bytes()[:26]
    if len(header) == 26 and header[24] == 16 and header[25] != 0:
        raise ValueError("16-bit colour would be cut to 8 bit; store it as 16-bit grey")
    with Image.open(path) as image:
        image.load()
        if image.mode in ("L", "I;16", "I;16B", "I"):
            pixels = np.asarray(image)
            return pixels.astype(np.uint16) if image.mode != "L" else pixels
        pixels = np.asarray(image.convert("RGBA"))
    if (pixels[..., 3] != 255).any():
        raise ValueError("it is partly transparent; store it as grey without transparency")
    if (pixels[..., :1] != pixels[..., :3]).any():
        raise ValueError("its colour channels differ; store it as grey")
    return pixels[..., 0]
