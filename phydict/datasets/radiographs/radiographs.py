"""Measured X-rays as a Case: a folder of images, what geometry.yaml says of them, and optionally `report.txt`.

Images are PNG or TIFF (8 or 16 bit, grey or with equal colour channels), NPY (V, U), NIfTI (U, V), one per view, or
DICOM with one or more frames, in the natural order of their names: view_2 comes before view_10. Row 0 is superior once
`orientation` has been applied.
"""

from __future__ import annotations

import os
import reprlib
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import torch
import yaml
from PIL import Image

from phydict.datasets.case import Case
from phydict.datasets.dicom import DicomTags, read_dicom, shown, tags_intensity, warn_of_frames
from phydict.datasets.intensity import KINDS, Intensity, check_of_patient
from phydict.datasets.natural_order import natural_order
from phydict.datasets.radiographs.saturation import saturated
from phydict.datasets.radiographs.xray_description import GEOMETRY, Description, read_description
from phydict.datasets.radiographs.xray_images import ENDINGS, image_files, is_dicom, read_image
from phydict.datasets.reports import format_report
from phydict.runtime.files import atomic_write
from phydict.runtime.reading import name_of, naming, one_line, read_text
from phydict.runtime.shipped import own_or_shipped
from phydict.runtime.warning import warn
from phydict.xray.geometry import ConeBeam

REPORT = "report.txt"
NEARLY_REPORT = REPORT, "report.md", "report"
"""Names that a report is likely to have in place of its own, in lower case."""
MOST_REPORT = 2**18
"""Bytes of the longest report, some 40,000 words."""
BLANK = 0.99
"""The share of an image's pixels that may not be all as dense as its densest."""


def find_xrays(path: str | Path) -> list[Path]:
    """The case folders at `path`: itself if it holds geometry.yaml or images, else its subfolders that do.

    Raises FileNotFoundError where there is none.
    """
    path = own_or_shipped(path)
    if not path.is_dir():
        raise FileNotFoundError(f"there is no folder {path}; give a folder of X-rays, or a folder of such folders")
    if _is_case(path):
        return [path]
    cases = sorted((p for p in path.iterdir() if p.is_dir() and _is_case(p)), key=lambda p: natural_order(p.name))
    if not cases:
        raise FileNotFoundError(f"neither {path} nor its subfolders hold {GEOMETRY} or X-ray images "
                                f"({', '.join(ENDINGS)}); give a folder of X-ray images")
    return cases


def load_xrays(folder: str | Path, geometry: str | Path | None = None, intensity: Intensity | None = None) -> Case:
    """The Case of one folder of X-rays.

    geometry: a geometry file used instead of the folder's geometry.yaml: such a YAML, or any that
    `phydict.xray.geometry_files` reads. intensity: used instead of the YAML's block. Without either, DICOM's tags
    decide, other floating-point images are taken as line integrals, and integer images are refused.
    Returns {"id": folder name, "xrays": (K,V,U) float32, "beam": ConeBeam, "report": str, "display": bool,
    "uncertain": Uncertain or None, "description": Description}, and "mu_water" where the geometry file says it; with
    display True, the X-rays are display values whose gain and offset per view are unknown; uncertain: what the geometry
    file is not sure of, or, where CR and DX tags state the beam and no file says it, `by_hand`; description: all that
    the file says.
    Raises FileNotFoundError for a missing folder, geometry or images, ValueError for everything that does not fit.
    """
    folder = own_or_shipped(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}; give a folder of X-ray images with {GEOMETRY}")
    source = folder / GEOMETRY if geometry is None else own_or_shipped(geometry)
    files = image_files(folder)
    tagged = len(files) > 0 and all(is_dicom(file) for file in files)
    described = read_description(source, needed=geometry is not None or not tagged) if files else Description(source)
    intensity = intensity or described.intensity
    references = described.reference_files(intensity)
    apart = {path.resolve() for path in chain(described.named_files(), *references.values())}
    views = _read_views([file for file in files if file.resolve() not in apart])
    if not views.images:
        raise FileNotFoundError(f"{folder} holds no X-ray image; put one of {', '.join(ENDINGS)} per view there")
    _check_count(folder, source, len(views.images), described.views)
    upright = described.orientation.shape
    beam = described.beam_of(upright(views.images[0].shape), views.tags)
    _check_count(folder, source, len(views.images), beam.views)
    for name, image in zip(views.names, views.images):
        rows, columns = upright(image.shape)
        if (rows, columns) != beam.shape:
            other = (f"{views.names[0]} has {beam.shape[0]} x {beam.shape[1]}; crop or pad them to one size"
                     if upright(views.images[0].shape) == beam.shape else
                     f"{source} describes a detector of {beam.shape[0]} x {beam.shape[1]}; correct `shape` and `pixel`")
            raise ValueError(f"{name} has {rows} x {columns} pixels (rows x columns), but {other}")
    if views.tags:
        intensity = shown(intensity or tags_intensity(views.tags), views.tags)
    intensity = intensity or _assumed(views, folder, source)
    flat_and_dark = {name: _mean(paths, views.images[0]) for name, paths in references.items()}
    pixels = np.stack(views.images)
    with naming(folder):
        xrays = intensity.line_integrals(pixels.astype(np.float64), views.full_scale, flat_and_dark)
    if intensity.kind == "counts" and not (pixels % 1).any():  # DICOM's are floating-point numbers once rescaled
        xrays[saturated(pixels)] = 0.0
    _check_shown(views.names, xrays)
    case: Case = {"id": name_of(folder.absolute()), "beam": beam, "report": _read_report(folder),
            "xrays": torch.from_numpy(described.orientation.apply(xrays).astype(np.float32)),
            "display": intensity.kind == "display", "uncertain": described.uncertain_of(beam, views.tags),
            "description": described}
    if described.mu_water is not None:
        case["mu_water"] = described.mu_water
    return case


def case_files(folder: Path, geometry: Path | None) -> list[Path]:
    """The files that decide what `load_xrays` makes of a folder: all that lie there, the geometry file used instead of
    its own, and those that a geometry file names elsewhere, whether they are there or not."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    source = folder / GEOMETRY if geometry is None else geometry
    with suppress(ValueError, OSError):  # what is wrong with it is reported where the case is read
        files += read_description(source).named_files()
    return list(dict.fromkeys([*files, geometry] if geometry else files))


def save_xrays(folder: str | Path, xrays: torch.Tensor | np.ndarray, beam: ConeBeam, report: str = "",
               png: bool = False, overwrite: bool = False) -> None:
    """Write line integrals (K, V, U) as view_<k>.npy, or 16-bit PNG, with geometry.yaml and report.txt.

    `load_xrays` reads them back: NPY as float32 exactly, PNG to half a step of range / 65535.
    overwrite: whether a case that lies there is replaced, its report included.
    Raises ValueError where the X-rays do not fit the beam or would not be read back, FileExistsError where other images
    lie in the folder, or a case that is not to be replaced.
    """
    if not isinstance(beam, ConeBeam):
        raise ValueError("save_xrays takes a folder, X-rays and a ConeBeam, in that order, but "
                         f"{one_line(reprlib.repr(beam))} was given as the beam")
    if isinstance(xrays, torch.Tensor):
        xrays = xrays.detach().float().cpu().numpy()
    xrays = np.asarray(xrays, np.float32)
    if xrays.shape != (beam.views, *beam.shape):
        raise ValueError(f"X-rays of shape {xrays.shape} were given for a beam of (views, rows, columns) "
                         f"{(beam.views, *beam.shape)}; give the X-rays of this beam")
    if not np.isfinite(xrays).all():
        raise ValueError("the X-rays hold NaN or infinite values; give finite line integrals")
    check_of_patient(xrays, "give those of attenuation in 1/mm along mm")
    _check_shown([f"view {k}" for k in range(beam.views)], xrays)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"view_{k}.{'png' if png else 'npy'}" for k in range(beam.views)]
    others = [file.name for file in image_files(folder) if file.name not in names]
    if others:
        raise FileExistsError(f"{folder} already holds other images ({', '.join(others)}); give an empty folder")
    there = [name for name in (*names, GEOMETRY, REPORT) if os.path.lexists(folder / name)]
    if there and not overwrite:
        raise FileExistsError(f"{folder} already holds {', '.join(there[:3])}; give another folder, or overwrite=True")
    low, high = float(xrays.min()), float(xrays.max())
    scale = max(high - low, 1e-6) / 65535
    intensity = {"kind": "line_integrals"} | ({"scale": scale, "offset": low} if png else {})
    content = {"beam": beam.to_dict(), "intensity": intensity,
               "orientation": {"flip_rows": False, "flip_columns": False}}
    with ExitStack() as whole:  # all is written before any of it takes its place
        def part(name: str) -> Path:
            return whole.enter_context(atomic_write(folder / name))

        part(GEOMETRY).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
        for name, image in zip(names, xrays):
            if png:
                levels = np.rint((image.astype(np.float64) - low) / scale).clip(0, 65535).astype(np.uint16)
                Image.fromarray(levels).save(part(name))
            else:
                np.save(part(name), image)
        if report:
            part(REPORT).write_text(report + "\n", encoding="utf-8")
    if not report:
        (folder / REPORT).unlink(missing_ok=True)


def _check_shown(names: list[str], xrays: np.ndarray) -> None:
    """Raises ValueError, with its name, where a view of line integrals (K, V, U) shows nothing."""
    blank = (xrays == xrays.max((1, 2), keepdims=True)).mean((1, 2)) >= BLANK
    if blank.any():
        raise ValueError(f"{names[blank.argmax()]} shows nothing: {BLANK:.0%} of its pixels or more hold "
                         "its densest value, as in a missing or saturated image; export it again, or leave the view "
                         "out of the images and of the geometry")


def _check_count(folder: Path, source: Path, images: int, views: int | None) -> None:
    if views not in (None, images):
        raise ValueError(f"{folder} holds {images} images, but {source} describes {views} views; give one image per "
                         "view")


def _is_case(folder: Path) -> bool:
    return (folder / GEOMETRY).is_file() or bool(image_files(folder))


@dataclass(frozen=True)
class _Views:
    """Stored images (V, U) with their names, and their tags where they are DICOM."""

    names: list[str]
    images: list[np.ndarray]
    tags: list[DicomTags]

    @property
    def full_scale(self) -> float:
        """The largest value that the images' type can hold; of types beyond 16 bits the largest that they do hold."""
        if np.issubdtype(self.images[0].dtype, np.integer) and self.images[0].dtype.itemsize <= 2:
            return float(np.iinfo(self.images[0].dtype).max)
        return max(*(float(np.abs(image).max()) for image in self.images), 1e-12)


def _read_views(files: list[Path]) -> _Views:
    """Raises ValueError where the files cannot be read or are of several kinds."""
    tagged = [file for file in files if is_dicom(file)]
    if tagged:
        other = [file.name for file in files if file not in tagged]
        if other:
            raise ValueError(f"{files[0].parent} holds DICOM files and others ({other[0]}); keep one kind there")
        frames = [frame for file in files for frame in read_dicom(file)]
        all_tags = [tags for _, tags in frames]
        views = _Views([tags.name for tags in all_tags], [pixels for pixels, _ in frames], all_tags)
        if len({(tags.inverted, tags.relationship, tags.sign) for tags in all_tags}) > 1:
            raise ValueError(f"the DICOM files of {files[0].parent} differ in PhotometricInterpretation or "
                             "PixelIntensityRelationship; keep views of one kind in a folder")
        warn_of_frames(all_tags)
        return views
    views = _Views([str(file) for file in files], [read_image(file) for file in files], [])
    kinds = sorted({str(image.dtype) for image in views.images})
    if len(kinds) > 1:
        raise ValueError(f"the images of {files[0].parent} have different pixel types ({', '.join(kinds)}); store all "
                         "views alike")
    return views


def _assumed(views: _Views, folder: Path, source: Path) -> Intensity:
    """What images without a word about their intensity are taken for."""
    kind = views.images[0].dtype
    if np.issubdtype(kind, np.integer):
        where = "there" if source.suffix.lower() in (".yaml", ".yml") else (
            f"in a YAML with `beam: {{file: {source.name}}}`, given in its place,")
        raise ValueError(f"the images of {folder} hold {kind} pixels and {source} has no `intensity:`; say {where} "
                         f"what they mean: kind {', '.join(KINDS)}")
    return Intensity("line_integrals")


def _mean(paths: list[Path], view: np.ndarray) -> np.ndarray:
    """The mean (V, U) of all frames of the reference images of a view."""
    for path in paths:
        if not path.is_file():
            raise FileNotFoundError(f"there is no image {path}, which `intensity:` names; correct the name")
    views = _read_views(paths)
    for name, image in zip(views.names, views.images):
        if image.shape != view.shape:
            raise ValueError(f"{name} has {image.shape[0]} x {image.shape[1]} pixels, but the views have "
                             f"{view.shape[0]} x {view.shape[1]}; give references of the same detector")
        if {image.dtype, view.dtype} == {np.dtype(np.uint8), np.dtype(np.uint16)}:
            raise ValueError(f"{name} holds {image.dtype} pixels, but the views {view.dtype}, whose counts are on "
                             "another scale; store all alike")
    return np.mean([image.astype(np.float64) for image in views.images], axis=0)


def _read_report(folder: Path) -> str:
    path = folder / REPORT
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, but a report is a text file of that name: rename the folder, or "
                                "put the text in its place")
    if path.is_file():
        return format_report(read_text(path, MOST_REPORT))
    if alike := sorted(file.name for file in folder.iterdir() if file.name.lower() in NEARLY_REPORT and file.is_file()):
        warn(f"{folder} has no {REPORT}, so that no report is used: {alike[0]} is not read; rename it to {REPORT}")
    return ""
