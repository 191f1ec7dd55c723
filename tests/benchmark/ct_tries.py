"""Tries of robustness.py: CTs, series, tables of CT-RATE, and prepared cases."""

from __future__ import annotations

import gzip
import json
import shutil

import numpy as np
from dicom_files import write_ct_series, write_dicom
from tries import box


def cts():
    """NIfTI CTs in test."""
    no = False
    box_ = box()

    def header(good, word, **fields):
        return good, word, lambda p: p.test(p.ct("ct.nii", header=fields))

    yield "as it should be", True, "", lambda p: p.test(p.ct())
    yield "without orientation", no, "sform", lambda p: p.test(p.ct(header={"sform_code": 0, "qform_code": 0}))
    yield "qform of nan", *header(None, "", sform_code=0, qform_code=1, quatern_b=float("nan"))
    yield "qform of 5", *header(None, "ct.nii", sform_code=0, qform_code=1, quatern_b=5.0)
    yield "sform of inf", *header(no, "ct.nii", srow_x=[float("inf"), 0, 0, 0])
    yield "sform of 0", *header(no, "ct.nii", srow_x=[0, 0, 0, 0])
    yield "sform far away", *header(no, "ct.nii", srow_x=[10, 0, 0, 1e9])
    yield "sform with shear", *header(None, "ct.nii", srow_x=[10, 8, 0, 0])
    yield "voxels of 99 mm", *header(None, "ct.nii", srow_x=[99, 0, 0, 0], srow_y=[0, 99, 0, 0], srow_z=[0, 0, 99, 0])
    yield "voxels of 60 mm", *header(None, "ct.nii", srow_x=[60, 0, 0, 0], srow_y=[0, 60, 0, 0], srow_z=[0, 0, 60, 0])
    yield "voxels of 0.02 mm", *header(None, "ct.nii", srow_x=[.02, 0, 0, 0], srow_y=[0, .02, 0, 0], srow_z=[0, 0, .02,
        0])
    yield "code 9", *header(None, "", sform_code=9)
    yield "units unknown", *header(None, "", xyzt_units=255)
    yield "slope 0", *header(None, "", scl_slope=0.0)
    yield "slope nan and intercept inf", *header(None, "", scl_slope=float("nan"), scl_inter=float("inf"))
    yield "slope inf", *header(None, "ct.nii", scl_slope=float("inf"))
    yield "slope 1e30", *header(None, "", scl_slope=1e30)
    yield "dim 0 of 0", *header(no, "ct.nii", dim=[0, 20, 20, 20, 1, 1, 1, 1])
    yield "dim with 0", *header(no, "ct.nii", dim=[3, 20, 0, 20, 1, 1, 1, 1])
    yield "dim of 32767^3", *header(no, "ct.nii", dim=[3, 32767, 32767, 32767, 1, 1, 1, 1])
    yield "four axes of 1", *header(True, "", dim=[4, 20, 20, 20, 1, 1, 1, 1])
    yield "four axes", *header(no, "ct.nii", dim=[4, 20, 20, 10, 2, 1, 1, 1])
    yield "a vector of 7 axes", *header(no, "ct.nii", dim=[7, 10, 10, 10, 1, 1, 2, 4])
    yield "type complex", *header(no, "ct.nii", datatype=32, bitpix=64)
    yield "type RGBA", *header(no, "ct.nii", datatype=2304, bitpix=32)
    yield "type 9999", *header(no, "ct.nii", datatype=9999)
    yield "bitpix that lies", *header(None, "", bitpix=8)
    yield "sizeof_hdr 349", *header(None, "", sizeof_hdr=349)
    yield "pixdim of nan", *header(None, "", pixdim=[float("nan")] * 8)
    for name, hu in (("all nan", box_ * np.nan), ("all one value", box_ * 0), ("all air", box_ * 0 - 1000), ("huge",
        box_ * 1e30),
                     ("of uint8", (box_ / 10 + 110).astype("u1")), ("inverted", -box_),
                     ("7 slices", box_[:, :, :7]), ("8 slices", box_[:, :, :8]), ("one slice", box_[:, :, :1]),
                     ("a line", box_[:, :1, :1]), ("noise", np.random.default_rng(0).normal(0, 5000,
                     box_.shape).astype("f4"))):
        yield f"voxels {name}", None, "ct", lambda p, hu=hu: p.test(p.ct("ct.nii", hu=hu))
    yield "cut", no, "ct.nii", lambda p: p.test(p.ct("ct.nii", change=lambda raw: raw[:9000]))
    yield "gz cut", no, "ct.nii.gz", lambda p: (f := p.ct(), f.write_bytes(f.read_bytes()[:-900]), p.test(f))
    yield "gz with a damaged middle", no, "ct.nii.gz", lambda p: (f := p.ct(), (b := bytearray(f.read_bytes())),
        b.__setitem__(
        slice(3000, 3100), bytes(100)), f.write_bytes(b), p.test(f))
    yield "gz twice", no, "ct.nii.gz", lambda p: (f := p.ct(), f.write_bytes(gzip.compress(f.read_bytes())), p.test(f))
    yield "gz with rubbish behind", None, "", lambda p: (f := p.ct(), f.write_bytes(f.read_bytes() + b"rubbish" * 99),
        p.test(f))
    yield "a gzip bomb of 4 GB behind the voxels", None, "", lambda p: (f := p.ct(change=lambda raw: raw[:352]),
        f.write_bytes(
        gzip.compress(gzip.decompress(f.read_bytes())) + gzip.compress(bytes(10**7), 9) * 400), p.test(f))
    yield "an empty file", no, "ct.nii.gz", lambda p: p.test(p.write("ct.nii.gz", b""))
    yield "a text", no, "ct.nii", lambda p: p.test(p.write("ct.nii", "hello"))
    yield "a pair's header", no, "", lambda p: p.test(p.write("ct.hdr", "hello"))
    yield "a folder without CTs", no, "", lambda p: p.test(p.case())
    yield "a folder that is not there", no, "nowhere", lambda p: p.test(p.given / "nowhere")
    yield "one bad of two", no, "bad", lambda p: (p.ct(), p.write("cts/bad.nii.gz", b"x"), p.test(p.given / "cts"))
    yield "a CT in two folders", None, "", lambda p: (p.ct("a/x.nii.gz"), p.ct("b/x.nii.gz"), p.test(p.given / "cts"))
    yield "a CT with two endings", no, "rename", lambda p: (p.ct("x.nii"), p.ct("x.nii.gz"), p.test(p.given / "cts"))
    yield "a link to its own folder", None, "", lambda p: (f := p.ct(), (f.parent / "loop").symlink_to(f.parent),
        p.test(f.parent))
    yield "a CT called results.csv", None, "", lambda p: p.test(p.ct("results.csv.nii.gz"))
    yield "a CT called results.md", None, "", lambda p: p.test(p.ct("results.md.nii.gz"))
    yield "a CT called phantom", True, "", lambda p: p.test(p.ct("phantom.nii.gz"))

    def damaged(content):
        def work(p):
            f = p.ct()
            p.test(f)
            p.write(p.out / "sirt/ct/reconstruction.json", content(
                (p.out / "sirt/ct/reconstruction.json").read_text()))
            p.test(f)
        return work

    def without(name):
        return lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != name})

    def with_(name, value):
        return lambda text: json.dumps(json.loads(text) | {name: value})

    yield "done twice", True, "", damaged(lambda text: text)
    for name in ("views", "grid", "scores", "seconds", "method", "files", "settings", "warnings", "network_calls"):
        yield f"a record without {name}", None if name in ("files",
            "warnings") else no, "reconstruction.json" if name not in ("files",
            "warnings") else "", damaged(without(name))
    yield "a record whose scores are words", no, "reconstruction.json", damaged(with_("scores", "good"))
    yield "a record whose scores hold words", None, "", damaged(with_("scores", {"psnr": "good"}))
    yield "a record whose seconds are a number", no, "reconstruction.json", damaged(with_("seconds", 3))
    yield "a record 10^5 deep", no, "reconstruction.json", damaged(lambda text: "[" * 10**5)
    yield "a record that is a list", no, "reconstruction.json", damaged(lambda text: "[]")
    yield "a record in UTF-16", no, "reconstruction.json", damaged(lambda text: text.encode("utf-16"))
    yield "a record of 5000 digits", no, "reconstruction.json", damaged(lambda text: "9" * 5000)
    yield "a table of binary", no, "results.csv", lambda p: (f := p.ct(), p.write(p.out / "sirt/results.csv",
        bytes(256)), p.test(f))


def series():
    """DICOM CT series, prepared."""
    no = False

    def ct(change=lambda folder, paths: None, **tags):
        def work(p):
            affine = np.diag([10.0, 10, 10, 1])
            paths = write_ct_series(p.given / "dicom" / "series", box(), affine, **tags)
            change(p.given / "dicom" / "series", paths)
            p.prepare(p.given / "dicom")
        return work

    yield "without lungs", no, "lungs", ct()
    yield "slices twice", no, "", ct(lambda d, f: shutil.copy(f[3], d / "again.dcm"))
    yield "a slice missing", no, "missing", ct(lambda d, f: f[7].unlink())
    yield "two slices", no, "slices", ct(lambda d, f: [x.unlink() for x in f[2:]])
    yield "modality MR", no, "MR", ct(Modality="MR")
    yield "no position", no, "ImagePositionPatient", ct(ImagePositionPatient=[])
    yield "position of words", no, "", ct(lambda d, f: f[0].write_bytes(f[0].read_bytes().replace(b"1.2.1", b"1.2.9")))
    yield "spacing 0", no, "PixelSpacing", ct(PixelSpacing=[0, 0])
    yield "spacing 1e30", no, "", ct(PixelSpacing=["1e30", "1e30"])
    yield "spacing of one", no, "PixelSpacing", ct(PixelSpacing=[1])
    yield "slope missing", no, "RescaleSlope", ct(RescaleSlope="")
    yield "slope 0", no, "", ct(RescaleSlope=0)
    yield "orientation of 0", no, "ImageOrientationPatient", ct(ImageOrientationPatient=[0] * 6)
    yield "rows larger in one slice", no, "slices", ct(lambda d, f: write_dicom(f[5], np.zeros((30, 20), np.uint16),
        "CT"))
    yield "a slice cut", no, "slice004", ct(lambda d, f: f[4].write_bytes(f[4].read_bytes()[:-300]))
    yield "a slice cut in its header", no, "", ct(lambda d, f: f[4].write_bytes(f[4].read_bytes()[:200]))
    yield "a slice empty", no, "", ct(lambda d, f: f[4].write_bytes(b""))
    yield "rubbish beside", no, "lungs", ct(lambda d, f: (d / "readme.txt").write_text("hello"))
    yield "a localizer", no, "localizer", ct(ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    yield "10 frames in a slice", no, "multi-frame", ct(NumberOfFrames=10)
    yield "a series called ..", no, "lungs", ct(SeriesNumber=0)


def tables():
    """CSV tables of reports and metadata."""
    no = False
    head = "VolumeName,Findings_EN,Impressions_EN\n"

    def report(content, good=True, word=""):
        return good, word, lambda p: p.test(p.ct(), f"--data.source.reports={p.write('r.csv', content)}")

    yield "as it should be", *report(head + "ct.nii.gz,Nodule.,Nodule.\n")
    yield "empty", *report("", no, "r.csv")
    yield "header alone", *report(head, no, "r.csv")
    yield "one field of 200000 letters", *report(head + f"ct.nii.gz,{'x' * 200000},y\n", None, "r.csv")
    yield "a quote that never ends", *report(head + 'ct.nii.gz,"Nodule', None, "")
    yield "a null byte", *report(head + "ct.nii.gz,a\0b,c\n", None, "r.csv")
    yield "more fields than columns", *report(head + "ct.nii.gz,a,b,c,d\n", no, "more fields than its header")
    yield "fewer fields", *report(head + "ct.nii.gz\n")
    yield "only commas", *report(head + ",,\n", no, "VolumeName")
    yield "a row twice", *report(head + "ct.nii.gz,a,b\nct,a,b\n", no, "two rows")
    yield "other columns", *report("name,text\nct,a\n", no, "columns")
    yield "semicolons", *report(head.replace(",", ";"), no, "columns")
    yield "UTF-16", *report(head.encode("utf-16"), no, "UTF-8")
    yield "a folder without tables", no, "CSV", lambda p: p.test(p.ct(), f"--data.source.reports={p.given}")
    yield "a table that is not there", no, "none.csv", lambda p: p.test(p.ct(), "--data.source.reports=none.csv")
    yield "an Excel file", no, "r.csv", lambda p: p.test(p.ct(),
        f"--data.source.reports={p.write('r.csv', b'PK' + bytes(range(128, 256)))}")
    meta = "VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n"

    def calibrated(row, good=no, word="", columns=meta):
        return good, word, lambda p: p.test(p.ct(), f"--data.source.metadata={p.write('m.csv', columns + row)}",
            "--data.source.fixed=false")

    yield "metadata as they should be", *calibrated('ct.nii.gz,1,0,"[10, 10]",10\n', True)
    yield "metadata missing", *calibrated("", no, "ct")
    yield "metadata spacing below 0", *calibrated('ct.nii.gz,1,0,"[-10, 10]",10\n', no, "Spacing")
    yield "metadata spacing of words", *calibrated('ct.nii.gz,1,0,"[a, b]",10\n', no, "XYSpacing")
    yield "metadata slope nan", *calibrated('ct.nii.gz,nan,0,"[10, 10]",10\n', no, "RescaleSlope")
    yield "metadata slope 1e300", *calibrated('ct.nii.gz,1e300,0,"[10, 10]",10\n', no)
    yield "metadata spacing 1e30", *calibrated('ct.nii.gz,1,0,"[1e30, 1e30]",1e30\n', no)
    yield "metadata spacing 500", *calibrated('ct.nii.gz,1,0,"[500, 500]",500\n', None)
    yield "metadata orientation of 0", *calibrated('ct.nii.gz,1,0,"[10, 10]",10,"[0,0,0,0,0,0]"\n', no, "",
        meta.strip() + ",ImageOrientationPatient\n")
    yield "metadata orientation of 5", *calibrated('ct.nii.gz,1,0,"[10, 10]",10,"[1,0,0,0,1]"\n', no,
        "ImageOrientationPatient", meta.strip() + ",ImageOrientationPatient\n")
    yield "metadata short row", *calibrated("ct.nii.gz,1\n", no, "")


def preparations():
    """data/prepare_cts.py."""
    no = False
    yield "without lungs", no, "lungs", lambda p: p.prepare(p.ct().parent)
    yield "voxels 0", no, "voxels", lambda p: p.prepare(p.ct().parent, "--voxels=0")
    yield "voxels 10^6", no, "", lambda p: p.prepare(p.ct().parent, "--voxels=1000000")
    yield "side nan", no, "side", lambda p: p.prepare(p.ct().parent, "--side=nan")
    yield "side inf", no, "side", lambda p: p.prepare(p.ct().parent, "--side=inf")
    yield "window nan", no, "window", lambda p: p.prepare(p.ct().parent, "--window=[nan,nan]")
    yield "space mars", no, "space", lambda p: p.prepare(p.ct().parent, "--space=mars")
    yield "segmenter eye", no, "segmenter", lambda p: p.prepare(p.ct().parent, "--segmenter=eye")
    yield "workers 0", no, "workers", lambda p: p.prepare(p.ct().parent, "--workers=0")
    yield "atlas a CT", no, "atlas", lambda p: p.prepare(p.ct().parent, f"--atlas={p.ct()}")
    yield "atlas not there", no, "nowhere", lambda p: p.prepare(p.ct().parent, "--atlas=nowhere.nii.gz")
    yield "out in the CTs", no, "", lambda p: (c := p.ct().parent, p.prepare(c, out=c / "x"))
    yield "out is a file", no, "", lambda p: p.prepare(p.ct().parent, out=p.write("f", "x"))
    yield "an empty folder", no, "", lambda p: p.prepare(p.given)
    yield "a file that is no CT", no, "", lambda p: p.prepare(p.write("x.txt", "x"))
    yield "an option that is not there", no, "colour", lambda p: p.prepare(p.ct().parent, "--colour=red")
    yield "an abbreviated option", no, "", lambda p: p.prepare(p.ct().parent, "--work=2")

    def prepared(content):
        def work(p):
            p.write("prepared/a/case.json", content)
            shutil.copy(p.ct(), p.given / "prepared/a/ct.nii.gz")
            p.test(p.given / "prepared")
        return work

    record = {"id": "a", "space": "patient", "extent": [200, 200, 200], "window": [-1000, 1000], "report": "",
    "row": {}}
    yield "a case as it should be", None, "", prepared(json.dumps(record | {"extent": [384, 384, 384]}))
    yield "a case too small", no, "a ", prepared(json.dumps(record))
    yield "a case 10^5 deep", no, "case.json", prepared("[" * 10**5)
    yield "a case of nulls", no, "case.json", prepared(json.dumps(dict.fromkeys(record)))
    yield "a case with an extent of nan", no, "", prepared(json.dumps(record | {"extent": [float("nan")] * 3}))
    yield "a case with an extent of texts", no, "case.json", prepared(json.dumps(record | {"extent": ["a", "b", "c"]}))
    yield "a case whose row is a list", no, "", prepared(json.dumps(record | {"row": [1]}))
    yield "a case whose id leads elsewhere", None, "", prepared(json.dumps(record | {"id": "../../x",
        "extent": [384] * 3}))
    yield "a case of 17 MB", no, "case.json", prepared(json.dumps(record | {"report": "x" * 2**25}))
    yield "a case in UTF-16", no, "case.json", prepared(json.dumps(record).encode("utf-16"))
