"""Fuzzers of everything that reads users' files: any bytes are either read or refused in one sentence.

`TARGETS` are the readers with samples to start from. tests/test_fuzzing.py gives them some inputs by Hypothesis;
tests/benchmark/robustness.py as many as there is time for, by Hypothesis and, where it is installed, by atheris.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import torch
import yaml
from dicom_files import orbit_tags, write_dicom
from edits import NUMBERS, TEXTS, Target, changed, edited, tables
from hypothesis import strategies as st
from PIL import Image
from prior.medsyn_files import entries, text_unet, write
from prior.tiny import tiny_prior
from safetensors.torch import save_file

from phydict import ConeBeam, load_prior
from phydict.ablation import read_specification
from phydict.datasets import load_ct, read_calibrations, read_reports
from phydict.datasets.cts.ct_series import Series, load_series
from phydict.datasets.cts.prepared import read_record
from phydict.datasets.dicom import read_dicom, tags_intensity
from phydict.datasets.radiographs.dicom_beam import tags_beam
from phydict.datasets.radiographs.xray_description import read_description
from phydict.datasets.radiographs.xray_images import read_image
from phydict.evaluation import read_csv
from phydict.inference.results import CaseResults
from phydict.prior.inspection import inspect_prior
from phydict.prior.tensors import read_torch
from phydict.runtime.configurations import read_configuration
from phydict.runtime.reading import read_ids
from phydict.xray.geometry_files import read_beam, write_beam

SECONDS = 10
RAW = re.compile(r"'NoneType'|has no attribute|object is not|invalid literal for|to unpack|list index|unhashable|"
                 r"not supported between|unsupported operand|expected str,|integer is required|object cannot")
"""Words of Python's own that tell a user nothing."""

SHAPE = (6, 5)
BEAM = ConeBeam.orbit(2, 1020.0, 740.0, SHAPE, (70.0, 80.0))
ORBIT = {"views": 2, "source_to_detector": 1020.0, "source_to_isocentre": 740.0, "shape": [6, 5], "pixel": [70.0, 80.0],
         "start_degrees": 0.0, "arc_degrees": 360.0}


def check(target: Target, content: bytes, folder: Path) -> bool:
    """Whether a file of this content is read; False where it is refused as it should be. Raises whatever else comes."""
    path = folder / target.name
    path.write_bytes(target.whole(content))
    began, read = time.process_time(), True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(path)
    except (ValueError, OSError) as error:
        said, read = str(error), False
        if "\n" in said.strip() or RAW.search(said) or len(said) > 1500 or target.name not in said:
            raise AssertionError(f"no sentence for a user: {type(error).__name__}: {said}") from error
    took = time.process_time() - began
    assert took < SECONDS, f"it took {took:.0f} s"
    return read


def contents(name: str) -> st.SearchStrategy[bytes]:
    """What a target is given: edited samples, and for texts with a structure that structure changed."""
    target, structured = TARGETS[name], STRUCTURED.get(name)
    return edited(target) if structured is None else st.one_of(edited(target), structured())


def _geometry_samples() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        BEAM.save(Path(folder) / "g.yaml")
        vectors = (Path(folder) / "g.yaml").read_bytes()
    return [vectors, yaml.safe_dump({"beam": {"orbit": ORBIT}}).encode(), *_described()]


def _described() -> list[bytes]:
    blocks = ({"kind": "line_integrals", "scale": 1e-4, "offset": 0.0},
              {"kind": "counts", "flat": ["a.png", "b.png"], "dark": 10.0, "floor": 1.0},
              {"kind": "display", "bright_is_dense": True})
    uncertain = {"detector_shift_mm": 5, "rotation_degrees": 2.0, "gain": 0.1}
    turn = {"rotate_degrees": 90, "flip_rows": True, "flip_columns": False}
    described = [{"beam": {"orbit": ORBIT}, "intensity": block, "orientation": turn, "uncertain": uncertain}
                 for block in blocks] + [{"beam": {"dicom": {"pixel": [1, 1], "source_to_isocentre": [765, 765]}}}]
    return [yaml.safe_dump(content).encode() for content in described]


def _beam_samples(ending: str) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"g{ending}"
            write_beam(path, BEAM)
            return [path.read_bytes()]
    return made


@cache
def _tiny() -> tuple[dict, dict]:
    prior = tiny_prior(text=False)
    return prior.describe(), {k: w.half().contiguous() for k, w in prior.state_dict().items()}


def _prior_samples() -> list[bytes]:
    header, weights = _tiny()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.safetensors"
        save_file(weights, path, {"phydict": json.dumps(header)})
        return [path.read_bytes()]


def _with_header(header: object) -> bytes:
    """A prior's file whose header is another."""
    outer = json.loads(_split_prior()[0])
    outer["__metadata__"]["phydict"] = json.dumps(header)
    return _headed(json.dumps(outer).encode())


_prior_samples_once = cache(_prior_samples)


def _split_prior() -> tuple[bytes, bytes]:
    """The header and the weights of a prior's file."""
    raw = _prior_samples_once()[0]
    end = 8 + struct.unpack("<Q", raw[:8])[0]
    return raw[8:end], raw[end:]


def _headed(header: bytes) -> bytes:
    return struct.pack("<Q", len(header)) + header + _split_prior()[1]


def _nifti(shape: tuple[int, ...], kind: str, spacing: float) -> bytes:
    data = np.random.default_rng(0).uniform(0, 5, shape).astype(kind)
    return nibabel.Nifti1Image(data, np.diag([spacing] * 3 + [1])).to_bytes()


def _pictures(ending: str) -> Callable[[], list[bytes]]:
    def made() -> list[bytes]:
        pixels = np.random.default_rng(0).integers(0, 60000, SHAPE).astype(np.uint16)
        with tempfile.TemporaryDirectory() as folder:
            found = []
            for n, image in enumerate((Image.fromarray(pixels),
                Image.fromarray((pixels >> 8).astype(np.uint8)).convert("RGB"))):
                path = Path(folder) / f"{n}{ending}"
                image.save(path)
                found.append(path.read_bytes())
            for kind, packed in (("f4", "tiff_lzw"), ("i4", "tiff_adobe_deflate"), ("u1", "packbits"))[
                    :3 * (ending == ".tif")]:
                Image.fromarray(pixels.astype(kind)).save(path, compression=packed)
                found.append(path.read_bytes())
            return found
    return made


def _npy_samples() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "v.npy"
        found = []
        for array in (np.zeros(SHAPE, np.float32), np.asfortranarray(np.ones(SHAPE, ">u2"))):
            np.save(path, array)
            found.append(path.read_bytes())
        return found


def _dicom_samples() -> list[bytes]:
    stored = np.random.default_rng(0).integers(0, 4000, (2, *SHAPE)).astype(np.uint16)
    with tempfile.TemporaryDirectory() as folder:
        run = write_dicom(Path(folder) / "run.dcm", stored, **orbit_tags(2, 1020.0, 740.0, (70.0, 80.0)),
                          RescaleSlope=1, RescaleIntercept=0, PixelIntensityRelationship="LOG",
                          PixelIntensityRelationshipSign=-1).read_bytes()
        slice_ = _slice(Path(folder) / "slice.dcm", 0).read_bytes()
        table = pydicom.Dataset()
        table.LUTDescriptor, table.ModalityLUTType = [4096, 0, 16], "US"
        table.add_new("LUTData", "OW", np.arange(0, 40960, 10, np.uint16).tobytes())
        looked = write_dicom(Path(folder) / "lut.dcm", stored[0], "DX", **orbit_tags(1, 1020.0, 740.0, (70.0, 80.0)) | {
            "ModalityLUTSequence": [table], "PatientOrientation": ["L", "F"], "ViewPosition": "PA",
            "EstimatedRadiographicMagnificationFactor": 1.4}).read_bytes()
        inner, outer = pydicom.Dataset(), pydicom.Dataset()
        inner.PositionerPrimaryAngle, inner.PositionerSecondaryAngle = 30.0, 0.0
        outer.PositionerPositionSequence = [inner]
        grouped = write_dicom(Path(folder) / "groups.dcm", stored, "XA", **orbit_tags(2, 1020.0, 740.0, (
            70.0, 80.0)) | {"PerFrameFunctionalGroupsSequence": [outer, outer], "SharedFunctionalGroupsSequence": [
                outer]}).read_bytes()
    return [run, slice_, looked, grouped]


def _read_dicom(path: Path) -> None:
    pixels, tags = zip(*read_dicom(path))
    if tags:
        tags_beam(list(tags), pixels[0].shape)
        tags_intensity(list(tags))


def _slice(path: Path, number: int) -> Path:
    """A CT slice, 5 mm above the one of the number before."""
    return write_dicom(path, np.full(SHAPE, 1000 + number, np.uint16), "CT", RescaleSlope=1, RescaleIntercept=-1024,
                       PixelSpacing=[1, 1], ImagePositionPatient=[0, 0, 5 * number], SeriesInstanceUID="1.2.3",
                       ImageOrientationPatient=[1, 0, 0, 0, 1, 0], ImageType=["ORIGINAL", "PRIMARY", "AXIAL"])


def _read_series(path: Path) -> None:
    others = [path.with_name(f"other{number}.dcm") for number in range(1, 9)]
    for number, other in enumerate(others, 1):
        if not other.exists():
            _slice(other, number)
    try:
        load_series(Series(path.parent, "1", (path, *others)))
    except ValueError as error:  # such a sentence begins with "its": preparation puts the folder before it
        if str(error).startswith(("its", "it ")) or "slices" in str(error):
            raise ValueError(f"{path}: {error}") from error
        raise


def _settings() -> dict:
    return {"model": {"method": {"class_path": "phydict.baselines.SIRT", "init_args": {"iterations": 3}}, "seed": 1},
            "data": {"orbit": {"views": 2}, "xrays": "x"}, "trainer": {"devices": 1}}


@cache
def _medsyn_samples() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [write(Path(folder) / "m.safetensors", entries(text_unet())).read_bytes()]


def _torch_samples() -> list[bytes]:
    found = []
    for zipped in (True, False):
        stream = io.BytesIO()
        torch.save({"phydict": {"grid": {"shape": [1]}}, "state_dict": {"a": torch.zeros(3)}}, stream,
                   _use_new_zipfile_serialization=zipped)
        found.append(stream.getvalue())
    return found


def _spec() -> dict:
    return {"out": "runs/x", "phantoms": 1, "base": {"views": 2, "voxels": 16, "detector": 24},
            "methods": {"mine": {"of": "sirt", "method.iterations": 3}},
            "axes": {"method": ["sirt", "mine"], "seed": [0, 1], "simulator.noise": [0.0, 0.01]}}


def _record() -> dict:
    return {"id": "a", "space": "patient", "extent": [384.0] * 3, "window": [-1000.0, 1000.0], "report": "",
            "row": {"remark": "x"}}


def _result() -> dict:
    return {"case": "a", "method": "sirt", "settings": {}, "source": "x", "scores": {"psnr": 20.5}, "views": 3,
            "grid": {"shape": [4, 4, 4]}, "seconds": {"all": 1.0}, "network_calls": 0, "projector_calls": 1,
            "warnings": ["x"], "files": ["volume.nii.gz"]}


def _read_result(path: Path) -> None:
    folder = path.parent / "results" / "a"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / path.name).write_bytes(path.read_bytes())
    results = CaseResults(folder.parent)
    try:
        left = results.unfinished({"a": "x"}, {})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error  # the sentence names the case's folder
    if not left:
        results.summarise(["a"])


TABLE = b"VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing,ImageOrientationPatient,Findings_EN," \
    b"Impressions_EN\n" b'train_1_a_1.nii.gz,1,-1024,"[0.7, 0.7]",1.5,"[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]",Nodule.,None.\n'

TARGETS = {
    "geometry": Target("geometry.yaml", ConeBeam.load, _geometry_samples, TEXTS),
    "description": Target("geometry.yaml", read_description, _described, TEXTS),
    "rtk": Target("g.xml", lambda path: read_beam(path, SHAPE, (70, 80)), _beam_samples(".xml"),
                  [*TEXTS, b"<a>" * 300, b"</Projection>", b"&x;", b'<!DOCTYPE a [<!ENTITY x "y">]>']),
    "beam table": Target("g.csv", lambda path: read_beam(path, SHAPE), _beam_samples(".csv"), TEXTS),
    "beam array": Target("g.npy", lambda path: read_beam(path, SHAPE), _beam_samples(".npy"), [*TEXTS, *NUMBERS]),
    "prior": Target("p.safetensors", load_prior, _prior_samples_once, [*TEXTS, *NUMBERS]),
    "prior's header": Target("p.safetensors", load_prior, lambda: [_split_prior()[0]], [*TEXTS, b"F16", b"I64", b'"'],
                             _headed),
    "inspect": Target("p.safetensors", lambda path: inspect_prior(path), _prior_samples_once, [*TEXTS, *NUMBERS]),
    "NIfTI image": Target("v.nii", read_image, lambda: [_nifti(SHAPE[::-1], "f4", 1.0)], NUMBERS),
    "NIfTI CT": Target("ct.nii", load_ct, lambda: [_nifti((9, 8, 10), "i2", 30.0)], NUMBERS),
    "NIfTI CT, squeezed": Target("ct.nii.gz", load_ct, lambda: [gzip.compress(_nifti((9, 8, 10), "i2", 30.0), mtime=0)],
                                 NUMBERS),
    "DICOM": Target("run.dcm", _read_dicom, _dicom_samples, [*NUMBERS, *(
        text for text in TEXTS if len(text) < 20), b"\xfe\xff\x00\xe0\xff\xff\xff\xff", b"SQ\0\0\xff\xff\xff\xff",
        b"UN", b"DS"]),
    "DICOM CT": Target("slice.dcm", _read_series, lambda: _dicom_samples()[1:2], [*NUMBERS, b"UN", b"SQ", b"\\"]),
    "PNG": Target("v.png", read_image, _pictures(".png"), [*NUMBERS, b"IDAT", b"PLTE", b"tRNS", b"acTL", b"fdAT"]),
    "TIFF": Target("v.tif", read_image, _pictures(".tif"), NUMBERS),
    "NPY": Target("v.npy", read_image, _npy_samples, [*NUMBERS, *TEXTS]),
    "reports table": Target("t.csv", read_reports, lambda: [TABLE], TEXTS),
    "metadata table": Target("t.csv", read_calibrations, lambda: [TABLE], TEXTS),
    "configuration": Target("c.yaml", read_configuration, lambda: [yaml.safe_dump(_settings()).encode()], TEXTS),
    "ids": Target("ids.txt", lambda path: read_ids(path, "data.only"), lambda: [b"a b\nc\n"], [*TEXTS, *NUMBERS]),
    "MedSyn": Target("m.safetensors", load_prior, _medsyn_samples, [
        *NUMBERS, b'"F32"', b'"I64"', b'"shape":[', b"downs.", b"init_conv", b"[]", b"[1]", b"0"]),
    "torch file": Target("c.ckpt", read_torch, _torch_samples, [*NUMBERS, b"c__builtin__\neval\n", b"R", b"(", b".",
                                                                b"PK", b"q\0", b"X"]),
    "results table": Target("r.csv", read_csv, lambda: [b"case,method,psnr\na,sirt,20.5\n"], TEXTS),
    "specification": Target("s.yaml", read_specification, lambda: [yaml.safe_dump(_spec()).encode()], TEXTS),
    "prepared case": Target("case.json", read_record, lambda: [json.dumps(_record()).encode()], TEXTS),
    "finished case": Target("reconstruction.json", _read_result, lambda: [json.dumps(_result()).encode()], TEXTS)}

STRUCTURED = {
    "geometry": lambda: changed({"beam": {"orbit": ORBIT}} | {}).map(_yaml) | changed(BEAM.to_dict()).map(_yaml),
    "description": lambda: changed(yaml.safe_load(_described()[0])).map(_yaml) | changed(
        yaml.safe_load(_described()[1])).map(_yaml),
    "prior": lambda: changed(_tiny()[0]).map(_with_header),
    "inspect": lambda: changed(_tiny()[0]).map(_with_header),
    "specification": lambda: changed(_spec()).map(_yaml),
    "configuration": lambda: changed(_settings()).map(_yaml),
    "reports table": lambda: tables(TABLE), "metadata table": lambda: tables(TABLE),
    "prepared case": lambda: changed(_record()).map(lambda c: json.dumps(_named(c)).encode()),
    "finished case": lambda: changed(_result()).map(lambda c: json.dumps(_named(c)).encode())}


def _yaml(content: object) -> bytes:
    return yaml.safe_dump(content, allow_unicode=True).encode(errors="surrogatepass")


def _named(content: object) -> object:
    """The same with names that JSON can hold."""
    if isinstance(content, dict):
        return {str(k): _named(v) for k, v in content.items()}
    return [_named(v) for v in content] if isinstance(content, list) else content
