"""Tries of robustness.py: X-rays as PNG, TIFF, NPY, DICOM and NIfTI, and their reports."""

from __future__ import annotations

import gzip
import os
import shutil
import struct
import zlib

import nibabel
import numpy as np
from PIL import Image
from tries import SIRT, png, png_chunk, xrays

from phydict.cli.infer import main as infer


def images():
    """PNG, TIFF and NPY views."""
    no = False

    def bytes_of(content, name="view_1.png"):
        return lambda p: p.predict(p.view(lambda f: f.write_bytes(content), name))

    array = xrays()[1].numpy()
    yield "npy in Fortran's order", True, "", lambda p: p.predict(p.view(lambda f: np.save(f,
        np.asfortranarray(array))))
    yield "npy big-endian", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype(">f4"))))
    yield "npy float16", no, "type", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype("f2"))))
    yield "npy of dates", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f,
        array.astype("i8").astype("M8[s]"))))
    yield "npy of texts", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype("U9"))))
    yield "npy of true and false", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, array > 1)))
    yield "npy of records", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((24, 24), [("a",
        "f4")]))))
    yield "npy without pixels", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((0, 24),
        "f4"))))
    yield "npy of one number", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.float32(3)))) 
    yield "npy with 32 axes", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.zeros((1,) * 32,
        "f4"))))
    yield "npy three views at once", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f,
        xrays().numpy())))
    yield "npy longdouble", no, "type", lambda p: p.predict(p.view(lambda f: np.save(f, array.astype(np.longdouble))))
    yield "npy with -inf", no, "view_1.npy", lambda p: p.predict(p.view(lambda f: np.save(f, np.where(array > 5,
        -np.inf, array))))
    yield "npy of 1e38", no, "", lambda p: p.predict(p.view(lambda f: np.save(f, array * np.float32(1e37))))
    yield "npy of -1e38", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, np.where(array > 3,
        np.float32(-1e38), array))))
    yield "npy of denormals", None, "", lambda p: p.predict(p.view(lambda f: np.save(f, array * np.float32(1e-42))))
    yield "npy integers of 64 bit", no, "intensity", lambda p: p.predict(p.view(
        lambda f: [np.save(f.with_name(f"view_{k}.npy"), (xrays()[k].numpy() * 2**40).astype("u8")) for k in range(3)],
        case=p.case(intensity=None)))
    yield "a view is a link to another", True, "", lambda p: p.predict(p.view(lambda f: f.symlink_to("view_0.npy")))
    yield "a view is a link to itself", no, "", lambda p: p.predict(p.view(lambda f: f.symlink_to(f.name)))
    yield "a view is a pipe", no, "", lambda p: (folder := p.view(lambda f: os.mkfifo(f)), infer(
        ["predict", *SIRT, f"--data.xrays={folder}", f"--model.out={p.out}"]))
    yield "a view is a folder", no, "", lambda p: p.predict(p.view(lambda f: f.mkdir()))
    yield "a view is empty", no, "view_1.png", bytes_of(b"")
    yield "PNG, signature alone", no, "view_1.png", bytes_of(b"\x89PNG\r\n\x1a\n")
    yield "PNG, 0 x 0", no, "view_1.png", bytes_of(png(0, 0))
    yield "PNG, 2^31 wide", no, "view_1.png", bytes_of(png(2**31 - 1, 1))
    yield "PNG, 13000 x 13000 of nothing", no, "", bytes_of(png(13000, 13000, data=b"\0" * (13001 * 13000)))
    yield "PNG, depth 3", no, "view_1.png", bytes_of(png(24, 24, depth=3))
    yield "PNG, broken checksum", no, "view_1.png", bytes_of(png(24, 24).replace(b"IDAT", b"IDAT\1"))
    yield "PNG, text of 100 MB squeezed", None, "", bytes_of(png(24, 24, more=png_chunk(
        b"zTXt", b"a\0\0" + zlib.compress(b"\0" * 10**8))))
    yield "PNG, colour profile of 100 MB", None, "", bytes_of(png(24, 24, more=png_chunk(
        b"iCCP", b"a\0\0" + zlib.compress(b"\0" * 10**8))))
    yield "PNG, transparent", no, "view_1.png", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.zeros((24, 24, 4), np.uint8)).save(f), "view_1.png"))
    yield "PNG with a palette", no, "", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.arange(576, dtype=np.uint8).reshape(24, 24)).convert("P").save(f), "view_1.png"))
    yield "PNG of one bit", no, "", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.eye(24, dtype=bool)).save(f), "view_1.png"))
    yield "animated PNG", no, "view_1.png", lambda p: p.predict(p.view(lambda f: Image.new("L", (24, 24)).save(
        f, save_all=True, append_images=[Image.new("L", (24, 24), 9)]), "view_1.png"))
    yield "GIF named PNG", no, "", lambda p: p.predict(p.view(lambda f: Image.new("L", (24, 24)).save(f, "GIF"),
        "view_1.png"))
    yield "PostScript named PNG", no, "view_1.png", bytes_of(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n(touch pwned) system\n")
    yield "XBM named PNG", no, "", bytes_of(
        b"#define x_width 24\n#define x_height 24\nstatic char x_bits[] = {0x00};\n")
    yield "PPM of 10^9 pixels named PNG", no, "view_1.png", bytes_of(b"P5 30000 30000 255 ")
    yield "TIFF float64 pages 2", no, "view_1.tif", lambda p: p.predict(p.view(lambda f: Image.new("F", (24, 24)).save(
        f, save_all=True, append_images=[Image.new("F", (24, 24))]), "view_1.tif"))
    yield "TIFF, LZW cut off", no, "view_1.tif", lambda p: p.predict(p.view(lambda f: (Image.fromarray(
        np.random.default_rng(0).integers(0, 255, (24, 24), np.uint8)).save(f, compression="tiff_lzw"),
        f.write_bytes(f.read_bytes()[:200])), "view_1.tif"))
    yield "TIFF whose pages lead to each other", no, "view_1.tif", bytes_of(
        b"II*\0\x08\0\0\0\x01\0\0\x01\x03\0\x01\0\0\0\x18\0\0\0\x08\0\0\0", "view_1.tif")
    yield "TIFF CMYK", no, "", lambda p: p.predict(p.view(lambda f: Image.new("CMYK", (24, 24)).save(f), "view_1.tif"))
    yield "PNG all equal", no, "nothing", lambda p: p.predict(p.pictures(lambda a: a * 0 + 7))
    yield "PNG one view inverted", None, "", lambda p: p.predict(p.pictures(lambda a: np.stack([a[0], 60000 - a[1],
        a[2]])))
    yield "PNG with one hot pixel", None, "", lambda p: p.predict(p.pictures(lambda a: np.where(np.arange(
        24) + 0 * a == 3, 65535, a).astype(np.uint16)))
    yield "PNG of other sizes", no, "pixels", lambda p: p.predict(p.view(
        lambda f: Image.fromarray(np.zeros((24, 25), np.uint16)).save(f), "view_1.png", p.pictures()))
    yield "PNG among NPY", no, "types", lambda p: p.predict(p.view(lambda f: Image.fromarray(
        (array * 1000).astype(np.uint16)).save(f), "view_1.png"))
    yield "images and their thumbnails", no, "images", lambda p: p.predict(p.view(lambda f: [shutil.copy(
        f.with_name("view_0.npy"), f.with_name(n)) for n in ("view_1.npy", "view_0 (copy).npy")], "x", p.case()))
    yield "Thumbs.db and .DS_Store beside", True, "", lambda p: (f := p.case(), p.write(f / "Thumbs.db", b"\xd0\xcf"),
        p.write(
        f / ".DS_Store", b"x"), p.write(f / "notes.docx", b"x"), p.predict(f))
    yield "a hidden image beside", True, "", lambda p: (f := p.case(), p.write(f / "._view_0.npy", b"x"), p.predict(f))
    yield "capital endings", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "VIEW_1.NPY"))
    yield "digits that are no numbers in a name", True, "", lambda p: p.predict(p.view(
        lambda f: np.save(open(f, "wb"), array), "view_1²3.npy"))
    yield "Arabic digits in a name", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "view_٣.npy"))
    yield "a name of 250 digits", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "9" * 250 + ".npy"))
    yield "a name that is no UTF-8", True, "", lambda p: p.predict(p.view(
        lambda f: np.save(open(os.fsencode(f.parent) + b"/view_\xe9.npy", "wb"), array)))
    yield "a name with a line break", True, "", lambda p: p.predict(p.view(lambda f: np.save(open(f, "wb"), array),
        "view\n1.npy"))
    yield "a truncated view with a line break in its name", no, "", bytes_of(b"\x89PNG", "view\n1.png")
    yield "one bad case of two", no, "bad", lambda p: (p.case("good"), p.view(
        lambda f: f.write_bytes(b"x"), case=p.case("bad")), p.predict(p.given))


def dicoms():
    """DICOM views."""
    no = False

    def tags(good, word, **given):
        return good, word, lambda p: p.predict(p.run_of(**given))

    yield "a run as it should be", *tags(True, "")
    yield "distance 0", *tags(no, "DistanceSourceToDetector", DistanceSourceToDetector=0)
    yield "distance below 0", *tags(no, "source_to_detector", DistanceSourceToDetector=-1020)
    yield "isocentre behind the detector", *tags(no, "source_to_isocentre", DistanceSourceToPatient=2000)
    yield "spacing of three", *tags(no, "ImagerPixelSpacing", ImagerPixelSpacing=[1, 1, 1])
    yield "spacing 0", *tags(no, "pixel", ImagerPixelSpacing=[0, 24])
    yield "no spacing", *tags(no, "ImagerPixelSpacing", ImagerPixelSpacing=None)
    yield "increments one short", *tags(no, "Increment", PositionerPrimaryAngleIncrement=[0, 1])
    yield "an angle of 1e300", *tags(None, "", PositionerPrimaryAngle="1e300")
    yield "a slope of 0", *tags(no, "", RescaleSlope=0, RescaleIntercept=0)
    yield "a slope of 1e300", *tags(no, "", RescaleSlope="1e300", RescaleIntercept=0)
    yield "16 bits in 12", *tags(None, "", BitsStored=12, HighBit=11)
    yield "bits stored above allocated", *tags(None, "", BitsStored=33)
    yield "bits allocated 7", *tags(no, "run.dcm", BitsAllocated=7)
    yield "bits allocated 64", *tags(no, "run.dcm", BitsAllocated=64)
    yield "rows 65535", *tags(no, "run.dcm", Rows=65535, Columns=65535)
    yield "rows 0", *tags(no, "run.dcm", Rows=0)
    yield "frames 0", *tags(None, "run.dcm", NumberOfFrames=0)
    yield "frames -3", *tags(None, "run.dcm", NumberOfFrames=-3)
    yield "frames 2^31", *tags(no, "run.dcm", NumberOfFrames=2**31 - 1)
    yield "three colours", *tags(no, "colour", SamplesPerPixel=3)
    yield "palette colour", *tags(None, "", PhotometricInterpretation="PALETTE COLOR")
    yield "MONOCHROME1 line integrals", *tags(None, "", PhotometricInterpretation="MONOCHROME1")
    yield "an unknown photometry", *tags(None, "", PhotometricInterpretation="MONOCHROME9")
    yield "an orientation of nonsense", *tags(no, "PatientOrientation", PatientOrientation=["X", "Y"])
    yield "an orientation along the ray", *tags(no, "PatientOrientation", PatientOrientation=["A", "F"])
    yield "modality CT", *tags(None, "", Modality="CT")
    yield "modality missing", *tags(None, "", Modality=None)

    def raw(change):
        def work(p):
            folder = p.run_of()
            file = folder / "run.dcm"
            file.write_bytes(bytes(change(bytearray(file.read_bytes()))))
            p.predict(folder)
        return work

    yield "cut in the pixels", no, "run.dcm", raw(lambda b: b[:-500])
    yield "cut in the tags", no, "run.dcm", raw(lambda b: b[:600])
    yield "preamble alone", no, "run.dcm", raw(lambda b: b[:132])
    yield "another transfer syntax", no, "run.dcm", raw(lambda b: b.replace(b"1.2.840.10008.1.2.1\0",
        b"1.2.840.10008.1.2.4\0"))
    yield "a deflated syntax without deflate", no, "run.dcm", raw(lambda b: b.replace(
        b"1.2.840.10008.1.2.1\0", b"1.2.840.10008.1.2.1.99"))
    yield "JPEG that is none", no, "run.dcm", raw(lambda b: b.replace(b"1.2.840.10008.1.2.1\0",
        b"1.2.840.10008.1.2.5\0"))
    yield "a sequence without end", no, "run.dcm", raw(lambda b: b + b"\xfe\xff\x00\xe0\xff\xff\xff\xff")
    yield "a length of 2 GB", None, "", raw(lambda b: b[:(n := b.index(
        b"\xe0\x7f\x10\x00OW") + 8)] + b"\xff\xff\xff\x7f" + b[n + 4:])

    def bomb(p):
        folder = p.run_of()
        raw = (folder / "run.dcm").read_bytes()
        start = raw.index(b"\x08\x00\x16\x00UI")
        head = raw[:start].replace(b"\x10\x00UI\x14\x00" + b"1.2.840.10008.1.2.1\0",
        b"\x10\x00UI\x16\x00" + b"1.2.840.10008.1.2.1.99")
        pack = zlib.compressobj(9, wbits=-15)
        body = pack.compress(raw[start:])
        for _ in range(60):
            body += pack.compress(b"\x09\x00\x10\x10UN\0\0" + struct.pack("<I", 10**7) + bytes(10**7))
        (folder / "run.dcm").write_bytes(head + body + pack.flush())
        p.predict(folder)

    yield "a deflated bomb of 600 MB", no, "run.dcm", bomb
    yield "DICOM named PNG", None, "", lambda p: (f := p.run_of(), (f / "run.dcm").rename(f / "run.png"), p.predict(f))
    yield "PNG named DICOM", no, "run2.dcm", lambda p: (f := p.run_of(), Image.new("L", (24, 24)).save(
        p.given / "x.png"), shutil.copy(p.given / "x.png", f / "run2.dcm"), p.predict(f))
    yield "a DICOMDIR beside", True, "", lambda p: (f := p.run_of(), p.write(f / "DICOMDIR", bytes(128) + b"DICM"),
        p.predict(f))
    yield "DICOM and NPY", no, "kind", lambda p: (f := p.run_of(), np.save(f / "v.npy", xrays()[0]), p.predict(f))
    yield "overrides of too many", no, "pixel", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {pixel: [[1,1],[1,1]]}}\nintensity: {kind: line_integrals}"), p.predict(f))
    yield "an override of nan", no, "source_to_isocentre", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {source_to_isocentre: .nan}}\nintensity: {kind: line_integrals}"),
        p.predict(f))
    yield "an override of an orientation that is a list", no, "patient_orientation", lambda p: (f := p.run_of(),
        p.write(
        f / "geometry.yaml", "beam: {dicom: {patient_orientation: [[L, F]]}}\nintensity: {kind: line_integrals}"),
        p.predict(f))
    yield "an empty override of orientation", no, "PatientOrientation", lambda p: (f := p.run_of(), p.write(
        f / "geometry.yaml", "beam: {dicom: {patient_orientation: ''}}\nintensity: {kind: line_integrals}"),
        p.predict(f))


def nifti_images():
    """NIfTI views."""
    no = False

    def view(array=None, change=lambda raw: raw, name="view_1.nii"):
        def write(f):
            image = nibabel.Nifti1Image(xrays()[1].numpy().T if array is None else array, np.eye(4))
            raw = bytes(change(bytearray(image.to_bytes())))
            f.write_bytes(gzip.compress(raw) if name.endswith(".gz") else raw)
        return lambda p: p.predict(p.view(write, name))

    def at(offset, data):
        return lambda raw: raw[:offset] + data + raw[offset + len(data):]

    yield "as it should be", True, "", view()
    yield "squeezed", True, "", view(name="view_1.nii.gz")
    yield "of three views", no, "view_1.nii", view(np.zeros((24, 24, 3), "f4"))
    yield "of 7 axes", None, "", view(xrays()[1].numpy().T.reshape(24, 24, 1, 1, 1, 1, 1))
    yield "voxels begin at nan", no, "view_1.nii", view(change=at(108, struct.pack("<f", float("nan"))))
    yield "voxels begin at inf", no, "view_1.nii", view(change=at(108, struct.pack("<f", float("inf"))))
    yield "voxels begin at -1000", no, "view_1.nii", view(change=at(108, struct.pack("<f", -1000.0)))
    yield "voxels begin at 1e30", no, "view_1.nii", view(change=at(108, struct.pack("<f", 1e30)))
    yield "voxels begin in the header", None, "", view(change=at(108, struct.pack("<f", 10.0)))
    yield "slope nan", None, "", view(change=at(112, struct.pack("<f", float("nan"))))
    yield "slope 1e38", no, "", view(change=at(112, struct.pack("<f", 1e38)))
    yield "type 0", no, "view_1.nii", view(change=at(70, struct.pack("<h", 0)))
    yield "type of one bit", no, "view_1.nii", view(change=at(70, struct.pack("<h", 1)))
    yield "type 128 bit", no, "view_1.nii", view(change=at(70, struct.pack("<h", 1536)))
    yield "8 axes", no, "view_1.nii", view(change=at(40, struct.pack("<h", 8)))
    yield "-1 axes", no, "view_1.nii", view(change=at(40, struct.pack("<h", -1)))
    yield "an axis below 0", no, "view_1.nii", view(change=at(42, struct.pack("<h", -24)))
    yield "an extension of 0 bytes", None, "", view(change=lambda raw: raw[:348] + b"\1\0\0\0" + struct.pack("<ii", 0,
        4) + raw[352:])
    yield "an extension of -16 bytes", no, "view_1.nii", view(change=lambda raw: at(108, struct.pack("<f", 400.0))(
        raw[:348] + b"\1\0\0\0" + struct.pack("<ii", -16, 4) + bytes(40) + raw[352:]))
    yield "an extension of 2 GB", no, "view_1.nii", view(change=lambda raw: at(108, struct.pack("<f", 400.0))(
        raw[:348] + b"\1\0\0\0" + struct.pack("<ii", 2**31 - 16, 4) + bytes(40) + raw[352:]))
    yield "two magic words", None, "", view(change=at(344, b"ni1\0"))
    yield "no magic word", no, "view_1.nii", view(change=at(344, b"abcd"))
    yield "cut in the header", no, "view_1.nii", view(change=lambda raw: raw[:200])
    yield "squeezed and cut", no, "view_1.nii.gz", lambda p: p.predict(p.view(lambda f: f.write_bytes(
        gzip.compress(nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes())[:-700]), "view_1.nii.gz"))
    yield "gz that is none", no, "view_1.nii.gz", lambda p: p.predict(p.view(lambda f: f.write_bytes(
        nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes()), "view_1.nii.gz"))
    yield "nii that is gz", no, "view_1.nii", lambda p: p.predict(p.view(lambda f: f.write_bytes(gzip.compress(
        nibabel.Nifti1Image(xrays()[1].numpy().T, np.eye(4)).to_bytes())), "view_1.nii"))
    yield "NIfTI 2", True, "", lambda p: p.predict(p.view(lambda f: nibabel.save(
        nibabel.Nifti2Image(xrays()[1].numpy().T, np.eye(4)), f), "view_1.nii"))


def reports():
    """report.txt."""
    def report(content):
        return lambda p: p.sampled(p.prior(), "--model.sampling.with_report=true") if content is None else (
            folder := p.case("other"), p.write(folder / "report.txt", content), p.infer(
                "predict", "-c", "prior_only", "--model.method.init_args.iterations=2", f"--model.prior={p.prior()}",
                f"--data.xrays={folder}", f"--model.out={p.out}", "--trainer.accelerator=cpu",
                "--model.sampling.guidance=2"))

    yield "as it should be", True, "", report(None)
    yield "empty", True, "", report("")
    yield "white space", True, "", report(" \n\t\r\n ")
    yield "a null byte", True, "", report("nodule\0nodule")
    yield "UTF-16", False, "report.txt", report("nodule".encode("utf-16"))
    yield "Latin-1", False, "report.txt", report("Größe".encode("latin1"))
    yield "one word of a million letters", False, "report.txt", report("x" * 10**6)
    yield "a million words", False, "report.txt", report("nodule " * 10**6)
    yield "a million headings", False, "report.txt", report("Findings: a\n" * 10**6)
    yield "16 MB of spaces", False, "report.txt", report(" " * (2**24 - 1))
    yield "17 MB", False, "report.txt", report("x" * (17 * 2**20))
    yield "40000 words", True, "", report("nodule " * 37000)
    yield "20000 headings", True, "", report("Findings: a\n" * 20000)
    yield "256 KB of spaces", True, "", report(" " * 2**18)
    yield "emoji and combining marks", True, "", report("🫁" * 1000 + "e\u0301" * 1000)
    yield "right-to-left and surrogates' neighbours", True, "", report("\u202e\ud7ff\ue000 nodule \U0010ffff")
    yield "special tokens", True, "", report("[CLS] [SEP] [MASK] [PAD] [UNK]")
    yield "rich markup", True, "", report("[/bold] [red]nodule")
    yield "a report that is a folder", False, "report.txt", lambda p: (
        f := p.case("other") / "report.txt").unlink() or f.mkdir() or p.predict(f.parent)
