"""Tries of robustness.py with files that pass for others, as strangers and attackers have them."""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib

import nibabel
import numpy as np
import pydicom
import torch
import yaml
from dicom_files import orbit_tags, write_dicom
from PIL import Image
from prior.medsyn_files import entries, text_unet
from safetensors.torch import save_file
from tries import BEAM, ORBIT, SIRT, box, npy, png, png_chunk, tiny, xrays

from phydict.cli.infer import main as infer

NO = False


def pictures_of_attackers():
    """Pictures and arrays that promise more than they are, or are another thing."""
    array = xrays()[1].numpy()

    def of(content, good=NO, word="view_1", name="view_1.png"):
        return good, word, lambda p: p.predict(p.view(lambda f: f.write_bytes(content), name))

    def tiff(width, height, **tags):
        values = {256: width, 257: height, 258: 1, 259: 1, 262: 1, 273: 122, 277: 1, 278: height, 279: 6}
        values |= {int(k[1:]): v for k, v in tags.items()}
        body = b"".join(struct.pack("<HHII", t, 4, 1, v) for t, v in sorted(values.items()))
        return struct.pack("<2sHIH", b"II", 42, 8, len(values)) + body + bytes(40)

    for name, content in (("of 33,554,438 rows in 182 bytes", tiff(5, 33554438)), ("of 10^4 colours",
        tiff(24, 24, t277=10**4)), ("whose strip lies behind its end", tiff(24, 24, t273=2**31)),
        ("with tiles of 0", tiff(24, 24, t322=0, t323=0, t324=8, t325=8)), ("of JPEG inside", tiff(24, 24, t259=7)),
        ("of fax", tiff(24, 24, t259=4)), ("of 4 x 10^9 rows per strip", tiff(24, 24, t278=2**32 - 1)),
        ("of 0 bits", tiff(24, 24, t258=0)), ("of 64 bits", tiff(24, 24, t258=64)), ("of floats of 7 bits",
        tiff(24, 24, t258=7, t339=3)), ("that is a BigTIFF cut off", b"II\x2b\0\x08\0\0\0" + b"\xff" * 8)):
        yield f"TIFF {name}", *of(content, None if "strip" in name else NO, name="view_1.tif", word="")
    yield "JPEG named PNG", None, "", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.arange(576, dtype=np.uint8).reshape(24, 24)).save(f, "JPEG"), "view_1.png"))
    yield "ICO named PNG", None, "", lambda p: p.predict(p.view(
        lambda f: Image.new("L", (24, 24)).save(f, "ICO"), "view_1.png"))
    yield "PNG within a PNG's text", None, "", lambda p: p.predict(p.view(lambda f: f.write_bytes(png(
        24, 24, more=png_chunk(b"tEXt", b"a\0" + png(9, 9)))), "view_1.png"))
    yield "PNG of 16 bits, interlaced", *of(b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", struct.pack(
        ">IIBBBBB", 24, 24, 16, 0, 0, 0, 1)) + png_chunk(b"IDAT", zlib.compress(bytes(9))) + png_chunk(b"IEND", b""))
    yield "SVG named PNG", *of(b"<svg xmlns='http://www.w3.org/2000/svg'><script>alert(1)</script></svg>")
    yield "a script named PNG", *of(b"#!/bin/sh\ntouch pwned\n")
    for name, header in (("a key of bytes", "{'descr': '<f4', 'fortran_order': False, b'shape': (24, 24), }"),
                         ("5000 axes", f"{{'descr': '<f4', 'fortran_order': False, 'shape': {(1,) * 5000}, }}"),
                         ("a shape of true", "{'descr': '<f4', 'fortran_order': False, 'shape': (True, True), }"),
                         ("a shape of text", "{'descr': '<f4', 'fortran_order': False, 'shape': ('24', 24), }"),
                         ("a list of lists", "[[1]]"), ("a type of void", "{'descr': '|V0', 'fortran_order': False, "
                         "'shape': (24, 24), }"), ("3000 fields", "{'descr': " + str([(f"f{i}", "<f4") for i in range(
                         3000)]) + ", 'fortran_order': False, 'shape': (1, 1), }"),
                         ("a sum for a shape", "{'descr': '<f4', 'fortran_order': False, 'shape': (9**9**9, 1), }")):
        yield f"NPY with {name}", *of(npy(header, bytes(20000)), name="view_1.npy")
    yield "a folder of 400 views", NO, "400", lambda p: (f := p.case(), [
        shutil.copy(f / "view_0.npy", f / f"more_{k}.npy") for k in range(397)], p.predict(f))
    yield "a view that is a link to /dev/zero", NO, "", lambda p: p.predict(p.view(lambda f: f.symlink_to("/dev/zero")))
    yield "a folder of X-rays that is a link", True, "", lambda p: (f := p.case(), (p.root / "l").symlink_to(f),
        p.predict(p.root / "l"))
    yield "X-rays at a trailing slash and dots", True, "", lambda p: (f := p.case(), p.predict(f"{f}/./../{f.name}//"))
    yield "X-rays in a tilde", NO, "~", lambda p: p.predict("~/nowhere")
    yield "X-rays given as one image", NO, "", lambda p: p.predict(p.case() / "view_0.npy")
    yield "X-rays given as geometry.yaml", NO, "", lambda p: p.predict(p.case() / "geometry.yaml")
    yield "X-rays given as a list", NO, "", lambda p: p.predict(f"[{p.case()}]")
    yield "X-rays given twice", None, "", lambda p: p.predict(p.case(), f"--data.xrays={p.case('b')}")
    yield "line integrals 1000 times too large", None, "", lambda p: p.view(lambda f: [np.save(
        f.with_name(f"view_{k}.npy"), 1000 * xrays()[k].numpy()) for k in range(3)]) and p.predict(p.given / "case")
    yield "views in another order", None, "", lambda p: p.view(lambda f: [np.save(
        f.with_name(f"view_{k}.npy"), xrays()[2 - k].numpy()) for k in range(3)]) and p.predict(p.given / "case")
    yield "a report that is a link to /dev/zero", None, "", lambda p: (f := p.case(), (f / "report.txt").unlink(),
        (f / "report.txt").symlink_to("/dev/zero"), infer(["predict", *SIRT, f"--data.xrays={f}",
                                                             f"--model.out={p.out}"]))
    yield "a view that shrinks", NO, "view_1.npy", lambda p: p.predict(p.view(lambda f: (np.save(f, array), os.truncate(
        f, 300))))


def geometry_by_hand():
    """geometry.yaml as it is typed, pasted or sent by mail."""
    good = yaml.safe_dump({"beam": {"orbit": ORBIT}, "intensity": {"kind": "line_integrals"}})
    for name, old, new, word in (
            ("a Cyrillic letter", "orbit", "оrbit", "geometry.yaml"), ("a zero-width space", "views", "vie\u200bws",
            "geometry.yaml"), ("a no-break space", "views: 3", "views:\u00a03", "geometry.yaml"),
            ("full-width digits", "views: 3", "views: \uff13", "views"), ("a decimal comma", "1020.0", "1020,0",
            "source_to_detector"), ("a thousands comma", "1020.0", "1,020.0", "source_to_detector"),
            ("a unit", "1020.0", "1020mm", "source_to_detector"), ("a degree sign", "views: 3",
            "views: 3\n    start_degrees: 90°", "start_degrees"), ("curly quotes", "line_integrals",
            "“line_integrals”", "kind"), ("a capital", "line_integrals", "Line_integrals", "kind"),
            ("a capital key", "intensity", "Intensity", "Intensity"), ("another indent", "  orbit", "      orbit",
            "") , ("a mail's mark", "beam", "> beam", "geometry.yaml"), ("an HTML page", "beam",
            "<!DOCTYPE html>\nbeam", "geometry.yaml"), ("a conflict's mark", "beam", "<<<<<<< HEAD\nbeam",
            "geometry.yaml"), ("no value", "views: 3", "views:", "views"), ("a formula", "1020.0", "3*340",
            "source_to_detector"), ("a fraction", "1020.0", "2040/2", "source_to_detector"), ("an environment's name",
            "1020.0", "${SDD}", "source_to_detector"), ("centimetres", "740.0", "74.0", ""),
            ("metres", "1020.0", "1.02", ""), ("a list in a list", "views: 3", "views: [3]", "views"),
            ("a NEL", "\n", "\u0085", "geometry.yaml"), ("a form feed", "views", "\x0cviews", "geometry.yaml")):
        yield name, None if name in ("another indent", "a no-break space", "a NEL") else NO, word, \
            lambda p, old=old, new=new: p.predict(p.case(text=good.replace(old, new, 1)))
    yield "pixel and shape the other way round", NO, "", lambda p: p.predict(p.case(orbit={"pixel": [24, 12],
        "shape": [24, 48]}))
    yield "half of an orbit", True, "", lambda p: p.predict(p.case(orbit={"arc_degrees": 180.0}))
    yield "an orbit the other way", True, "", lambda p: p.predict(p.case(orbit={"arc_degrees": -360.0}))
    vectors = BEAM.to_dict()
    for name, change in (
            ("in centimetres", {k: (np.asarray(vectors[k]) / 10).tolist() for k in ("sources", "detectors", "u", "v")}),
            ("with u and v exchanged", {"u": vectors["v"], "v": vectors["u"]}),
            ("with source and detector exchanged", {"sources": vectors["detectors"], "detectors": vectors["sources"]}),
            ("mirrored", {"u": (-np.asarray(vectors["u"])).tolist()}),
            ("a metre to the side", {k: (np.asarray(vectors[k]) + [1000, 0, 0]).tolist() for k in (
                "sources", "detectors")})):
        yield f"vectors {name}", None, "", lambda p, change=change: p.predict(p.case(beam=vectors | change))


def dicoms_of_strangers():
    """DICOM X-rays whose tags are of other kinds, sizes and encodings."""
    def table(**values):
        made = pydicom.Dataset()
        for keyword, (kind, value) in values.items():
            made.add_new(keyword, kind, value)
        return made

    def with_table(*items):
        return NO, "", lambda p: p.predict(p.run_of(ModalityLUTSequence=list(items)))

    data = ("OW", np.arange(4096, dtype=np.uint16).tobytes())
    yield "an empty LUT sequence", None, "", lambda p: p.predict(p.run_of(ModalityLUTSequence=[]))
    yield "a LUT without its descriptor", *with_table(table(LUTData=data))
    yield "a LUT without its data", *with_table(table(LUTDescriptor=("US", [4096, 0, 16])))
    yield "a LUT of no entries", *with_table(table(LUTDescriptor=("US", [4096, 0, 16]), LUTData=("OW", b"")))
    yield "a LUT shorter than it says", *with_table(table(LUTDescriptor=("US", [60000, 0, 16]), LUTData=data))
    yield "a LUT of 77 bits", *with_table(table(LUTDescriptor=("US", [4096, 0, 77]), LUTData=data))
    yield "a LUT of one number", *with_table(table(LUTDescriptor=("US", 4096), LUTData=data))

    def tag(keyword, kind, value):
        def work(p):
            folder = p.run_of()
            dataset = pydicom.dcmread(folder / "run.dcm")
            dataset.pop(keyword, None)
            dataset.add(pydicom.DataElement(keyword, kind, value))
            dataset.save_as(folder / "run.dcm")
            p.predict(folder)
        return work

    for keyword, kind, value in (
            ("NumberOfFrames", "LO", "many"), ("NumberOfFrames", "DS", "2.5"), ("Rows", "LO", "24"),
            ("Rows", "FD", float("nan")), ("Modality", "FD", 1.0), ("PatientOrientation", "FD", 2.0),
            ("PatientOrientation", "LT", "L\r\n" * 400), ("PositionerPrimaryAngle", "LT", "x" * 5000),
            ("ImagerPixelSpacing", "LO", ["a", "b"]), ("RescaleSlope", "FD", float("nan")),
            ("RescaleSlope", "LO", "steep"), ("PixelRepresentation", "US", 7), ("PixelRepresentation", "US", 1),
            ("BitsAllocated", "LO", "16"), ("SamplesPerPixel", "LO", "one"), ("PhotometricInterpretation", "FD", 3.0),
            ("PhotometricInterpretation", "CS", "YBR_FULL"), ("DistanceSourceToDetector", "DS", ["1020", "1020"]),
            ("ViewPosition", "LT", "PA\n" * 99), ("PerFrameFunctionalGroupsSequence", "SQ", []),
            ("PerFrameFunctionalGroupsSequence", "LO", "groups"), ("SharedFunctionalGroupsSequence", "SQ",
            [pydicom.Dataset()]), ("SpecificCharacterSet", "CS", "NONSENSE"), ("PatientName", "PN", "^" * 9999)):
        yield f"{keyword} {kind} {str(value)[:12]!r}", None, "", tag(keyword, kind, value)

    def enhanced(count):
        def work(p):
            inner, outer = pydicom.Dataset(), pydicom.Dataset()
            inner.PositionerPrimaryAngle, inner.PositionerSecondaryAngle = 30.0, 0.0
            outer.PositionerPositionSequence = [inner]
            p.predict(p.run_of(PerFrameFunctionalGroupsSequence=[outer] * count, PositionerPrimaryAngle=None))
        return work

    yield "groups of fewer frames", None, "", enhanced(1)
    yield "groups of more frames", None, "", enhanced(9)
    yield "runs of two angles in two files", None, "", lambda p: (f := p.run_of(), shutil.copy(
        f / "run.dcm", f / "run2.dcm"), p.predict(f))
    yield "an X-ray that is a CT's slice", NO, "", lambda p: (write_dicom(
        p.given / "run/a.dcm", np.zeros((24, 24), np.uint16), "CT"), p.predict(p.given / "run"))
    yield "an X-ray all black", NO, "", lambda p: (write_dicom(
        p.given / "run/a.dcm", np.zeros((3, 24, 24), np.uint16), **orbit_tags(3, 1020.0, 740.0, (24.0, 24.0))), p.write(
            "run/geometry.yaml", "intensity: {kind: line_integrals, scale: 1.0e-4}"), p.predict(p.given / "run"))


def volumes_of_strangers():
    """CTs of other number types and orders, and odd names."""
    turn = np.array([[0.7071, -0.7071, 0], [0.7071, 0.7071, 0], [0, 0, 1]]) * 10
    turned = np.eye(4)
    turned[:3, :3] = turn
    for name, good, hu, affine in (
            ("turned by 45 degrees", None, None, turned), ("left-handed", None, None, np.diag([-10.0, 10, 10, 1])),
            ("upside down", None, None, np.diag([10.0, -10, -10, 1])), ("axes exchanged", None, None, np.array(
                [[0, 10.0, 0, 0], [0, 0, 10, 0], [10, 0, 0, 0], [0, 0, 0, 1]])),
            ("of int64", None, "i8", None), ("of uint64", None, "u8", None), ("of float64", None, "f8", None),
            ("of int8", None, "i1", None)):
        def work(p, hu=hu, affine=affine):
            image = box() if hu is None else (box() / (10 if hu == "i1" else 1)).astype(hu)
            image = nibabel.Nifti1Image(image, np.diag([10.0, 10, 10, 1]) if affine is None else affine, dtype=hu)
            (p.given / "cts").mkdir()
            nibabel.save(image, p.given / "cts/ct.nii.gz")
            p.test(p.given / "cts")
        yield name, good, "", work
    yield "big-endian", None, "", lambda p: ((p.given / "cts").mkdir(), nibabel.save(nibabel.Nifti1Image(
        box(), np.diag([10.0, 10, 10, 1]), nibabel.Nifti1Header(endianness=">")), p.given / "cts/ct.nii"), p.test(
            p.given / "cts"))
    for name in (".nii.gz", "..nii.gz", " .nii.gz", "a b.nii.gz", "-rf.nii.gz", "$(touch pwned).nii.gz",
                 "results.nii.gz", "CON.nii.gz", "é.NII.GZ"):
        yield f"called {name!r}", None, "", lambda p, name=name: p.test(p.ct(name).parent)

    def record(change, *more):
        """A forged record in a finished case's place."""
        def work(p):
            f = p.ct()
            p.test(f)
            file = p.out / "sirt/ct/reconstruction.json"
            file.write_text(json.dumps(change(json.loads(file.read_text()))))
            p.test(f, *more)
        return work

    over = "--model.overwrite=true"
    yield "a record with a score called case", None, "", record(lambda r: r | {"scores": {"case": 3.0, "method": 2.0}})
    yield "a record with a score with a line break", None, "", record(lambda r: r | {"scores": {"a\nb|c": 3.0}})
    yield "a record of a method of half a letter", None, "", record(lambda r: r | {"method": "\ud800"})
    yield "a record of a score of 400 digits", None, "", record(lambda r: r | {"scores": {"psnr": 10**400}})
    yield "a record that lists /etc/passwd", None, "", record(lambda r: r | {"files": ["/etc/passwd", "../../../in"]},
        over)
    yield "a record that lists numbers", None, "", record(lambda r: r | {"files": [3, None]}, over)
    yield "a record that lists a text", None, "", record(lambda r: r | {"files": "abc"}, over)
    yield "a record of two grids", None, "", record(lambda r: r | {"grid": [r["grid"]] * 2})
    yield "a record of warnings of numbers", None, "", record(lambda r: r | {"warnings": [1, None]})


def priors_of_strangers():
    """Priors with names, sizes and networks that nobody exports."""
    first = next(iter(tiny()[1]))

    def raw(header: dict, data: bytes = b""):
        text = json.dumps(header).encode()
        return lambda p: p.sampled(p.write("tiny.safetensors", struct.pack("<Q", len(text)) + text + data))

    def medsyn(change):
        def work(p):
            weights = {k: w.clone() for k, w in entries(text_unet()).items()}
            save_file(change(weights), p.given / "m.safetensors")
            p.sampled(p.given / "m.safetensors")
        return work

    yield "metadata of numbers", NO, "", raw({"__metadata__": {"phydict": 3}})
    yield "metadata of a list", NO, "", raw({"__metadata__": ["phydict"]})
    yield "a type of 4 bits", NO, "", raw({"__metadata__": {"phydict": json.dumps(tiny()[0])}, "a": {
        "dtype": "F4", "shape": [2], "data_offsets": [0, 1]}}, b"\0")
    yield "a shape of 2^63", NO, "", raw({"a": {"dtype": "F32", "shape": [2**63], "data_offsets": [0, 4]}}, bytes(4))
    yield "a shape of -1", NO, "", raw({"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, bytes(4))
    yield "a name of a million letters", NO, "", lambda p: p.sampled(p.prior(weights={"a" * 10**6: torch.zeros(1)}))
    yield "a name with line breaks and NaN", NO, "tiny.safetensors", lambda p: p.sampled(p.prior(
        weights={"a\nb\n" * 99: torch.tensor([torch.nan])}))
    yield "inspect of a type of 4 bits", None, "", lambda p: (text := json.dumps({"__metadata__": {
        "phydict": json.dumps(tiny()[0])}, "a": {"dtype": "F4", "shape": [2], "data_offsets": [0, 1]}}).encode(),
        p.train("inspect-prior", p.write("x.safetensors", struct.pack("<Q", len(text)) + text + b"\0")))
    yield "inspect of a folder of folders", None, "", lambda p: ((p.given / "99999_ckpt/100000_ckpt").mkdir(
        parents=True), p.train("inspect-prior", p.given))
    yield "a vocabulary of a million words", None, "", lambda p: p.sampled(p.prior({"text": tiny()[0]["text"] | {
        "vocabulary": ["x"] * 10**6}}))
    yield "a file with bytes behind its end", None, "", lambda p: (f := p.prior(), f.write_bytes(
        f.read_bytes() + bytes(999)), p.sampled(f))
    yield "weights of another prior's size", NO, "tiny.safetensors", lambda p: p.sampled(p.prior(weights={
        first: torch.cat([tiny()[1][first]] * 2)}))
    yield "MedSyn's names, 9000 levels", NO, "", medsyn(lambda w: w | {
        f"denoise_fn.downs.{i}.x": torch.zeros(1) for i in range(9000)})
    yield "MedSyn's names, a first convolution of one number", NO, "m.safetensors", medsyn(lambda w: w | {
        "denoise_fn.init_conv.weight": torch.tensor(1.0)})
    yield "MedSyn's names, a first convolution of 10^6", NO, "m.safetensors", medsyn(lambda w: w | {
        "denoise_fn.init_conv.weight": torch.zeros(10**6, 1, 1, 1, 1)})
    yield "MedSyn's names, nothing else", NO, "m.safetensors", medsyn(lambda w: {
        "denoise_fn.init_conv.weight": w["denoise_fn.init_conv.weight"]})
    yield "MedSyn's names, a tensor of no axis for each", NO, "m.safetensors", medsyn(lambda w: {
        k: torch.tensor(1.0) for k in w})
    yield "MedSyn's names, integers", None, "", medsyn(lambda w: {k: v.int() for k, v in w.items()})
    yield "MedSyn's names, NaN", NO, "m.safetensors", medsyn(lambda w: {k: v * torch.nan for k, v in w.items()})
    yield "a .bin that is empty", NO, "", lambda p: p.sampled(p.write("pytorch_model.bin", b""))
