"""Tries of robustness.py: geometry.yaml, and the geometry files of others."""

from __future__ import annotations

import json
import os
from functools import partial

import numpy as np
import yaml
from tries import BEAM, ORBIT, PICKLE, SIRT, npy

from phydict.cli.infer import main as infer


def geometries():
    """geometry.yaml."""
    no = False

    def orbit(**changes):
        return lambda p: p.predict(p.case(orbit=changes))

    def text(content):
        return lambda p: p.predict(p.case(text=content))

    good = yaml.safe_dump({"beam": {"orbit": ORBIT}, "intensity": {"kind": "line_integrals"}})
    for key, value in (("views", "3"), ("views", 2.5), ("views", True), ("views", None), ("views", -3), ("views", []),
                       ("views", {"n": 3}), ("views", 10**30), ("pixel", "24"), ("pixel", [24, 24, 24]),
                       ("pixel", [[24, 24]]), ("pixel", [24, "24"]), ("pixel", -24), ("pixel", [24, 0]),
                       ("pixel", {"row": 24}), ("pixel", 1e300), ("pixel", 1e-300), ("shape", [24]), ("shape", "24x24"),
                       ("shape", [24, 24, 1]), ("shape", [0, 24]), ("shape", [24, -24]), ("shape", [24, 1e18]),
                       ("shape", [[24, 24], [24, 24]]), ("shape", 24), ("source_to_detector", "1020 mm"),
                       ("source_to_detector", 102.0), ("source_to_detector", [1020]), ("source_to_isocentre", 0),
                       ("source_to_isocentre", -740), ("source_to_isocentre", 1e-320), ("source_to_isocentre", 100),
                       ("start", 90), ("start", "0"), ("arc", 360), ("arc", float("nan")),
                       ("start_degrees", [0, 90, 180]), ("radius", 740), ("", 1), (None, 1), (3, 1)):
        named = str(key) if isinstance(key, str) and key else ""
        yield f"orbit.{key} {str(value)[:20]}", no, ("" if value in (1e-320, 100, 102.0) else "geometry.yaml",
            "" if named in ("source_to_isocentre", "shape", "pixel") else named), \
            orbit(**{key: value}) if isinstance(key, str) else partial(
                lambda p, key, value: p.predict(p.case(beam={"orbit": ORBIT | {key: value}})), key=key, value=value)
    yield "arc_degrees 0", None, "", orbit(arc_degrees=0)
    yield "arc_degrees 1e300", None, "", orbit(arc_degrees=1e300)
    yield "start_degrees -1e17", None, "", orbit(start_degrees=-1e17)
    yield "start_degrees and start", no, "start", orbit(start=0, start_degrees=0)
    yield "orbit is null", no, "geometry.yaml", text("beam: {orbit: null}")
    yield "orbit is a list", no, "geometry.yaml", text("beam: {orbit: [3, 1020, 740]}")
    yield "beam twice", no, "beam", text(good + good)
    yield "orbit and vectors", no, "geometry.yaml", text("beam: {orbit: {views: 3}, sources: []}")
    yield "an empty file", no, "geometry.yaml", text("")
    yield "only comments", no, "geometry.yaml", text("# nothing\n# here\n")
    yield "only a number", no, "geometry.yaml", text("42")
    yield "JSON", None, "", text(json.dumps({"beam": {"orbit": ORBIT}, "intensity": {"kind": "line_integrals"}}))
    yield "with a byte order mark", True, "", text("\ufeff" + good)
    yield "with Windows' line ends", True, "", text(good.replace("\n", "\r\n"))
    yield "in UTF-16", no, "UTF-8", text(good.encode("utf-16"))
    yield "in Latin-1", no, "UTF-8", text(("# Größe\n" + good).encode("latin1"))
    yield "with tabs", no, "geometry.yaml", text(good.replace("  ", "\t"))
    yield "a null byte", no, "geometry.yaml", text(good + "x: \0\n")
    yield "a control character", no, "geometry.yaml", text(good + "x: \x07\n")
    yield "two documents", no, "documents", text(good + "---\n" + good)
    yield "a document end and rubbish", no, "geometry.yaml", text(good + "...\n]]]]\n")
    yield "a python tag", no, "geometry.yaml", text("beam: !!python/object/apply:os.system ['touch pwned']")
    yield "a python tag on a number", no, "geometry.yaml", text(good.replace("views: 3", "views: !!python/int 3"))
    yield "a tag of one's own", no, "geometry.yaml", text(good.replace("views: 3", "views: !three 3"))
    yield "a set", no, "geometry.yaml", text("beam: !!set {a, b}")
    yield "binary", no, "geometry.yaml", text("beam: !!binary aGVsbG8=")
    yield "an alias before its anchor", no, "geometry.yaml", text("beam: *later\nx: &later 1")
    yield "an alias of itself", no, "geometry.yaml", text("beam: &b {orbit: *b}")
    yield "a merge of a list", no, "geometry.yaml", text("beam: {<<: [1, 2]}")
    yield "a merge of an orbit", True, "", text(
        "beam: {orbit: {<<: &o " + json.dumps(ORBIT) + "}}\nintensity: {kind: line_integrals}")
    yield "a key of 10^6 letters", no, "geometry.yaml", text("x" * 10**6 + ": 1\n")
    yield "a text of 16 MB", no, "", text("# " + "x" * (2**24 - 10) + "\nbeam: 1")
    yield "a text of 17 MB", no, "geometry.yaml", text("#" * (17 * 2**20))
    yield "10^5 keys", no, "geometry.yaml", text("".join(f"k{i}: 1\n" for i in range(10**5)))
    yield "octal numbers", None, "", text(good.replace("views: 3", "views: 0o3"))
    yield "sexagesimal", no, "geometry.yaml", text(good.replace("views: 3", "views: 3:00"))
    yield "1_0 with underscores", no, "geometry.yaml", text(good.replace("views: 3", "views: 3_0"))
    yield "yes for a flag", None, "", lambda p: p.predict(p.case(text=good + "orientation: {flip_rows: yes}\n"))
    yield "a flag in quotes", no, "flip_rows", lambda p: p.predict(p.case(orientation={"flip_rows": "true"}))
    yield "rotate 45", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": 45}))
    yield "rotate 90.0", None, "", lambda p: p.predict(p.case(orientation={"rotate_degrees": 90.0}))
    yield "rotate nan", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": float("nan")}))
    yield "rotate a list", no, "rotate_degrees", lambda p: p.predict(p.case(orientation={"rotate_degrees": [90]}))
    yield "orientation a word", no, "orientation", lambda p: p.predict(p.case(orientation="upright"))
    yield "orientation a list", no, "orientation", lambda p: p.predict(p.case(orientation=["flip_rows"]))
    yield "an orientation with a number as key", no, "orientation", lambda p: p.predict(p.case(orientation={1: True}))
    yield "an intensity with a number as key", no, "intensity", lambda p: p.predict(p.case(intensity={1: True}))
    for name, block, word in (
            ("kind a list", {"kind": ["counts"]}, "kind"), ("kind a mapping", {"kind": {"a": 1}}, "kind"),
            ("kind 1", {"kind": 1}, "kind"), ("scale in words", {"kind": "line_integrals", "scale": "big"}, "scale"),
            ("scale nan", {"kind": "line_integrals", "scale": float("nan")}, "scale"),
            ("scale 1e29", {"kind": "line_integrals", "scale": 1e29}, "scale"),
            ("scale true", {"kind": "line_integrals", "scale": True}, "scale"),
            ("offset a list", {"kind": "line_integrals", "offset": [0]}, "offset"),
            ("air 0", {"kind": "counts", "air": 0}, "air"), ("air -1", {"kind": "counts", "air": -1}, "air"),
            ("air and flat", {"kind": "counts", "air": 1, "flat": "f.npy"}, "air"),
            ("flat a number", {"kind": "counts", "flat": 3}, "flat"), ("flat empty", {"kind": "counts", "flat": []},
            ""),
            ("flat empty text", {"kind": "counts", "flat": ""}, ""),
            ("flat a folder", {"kind": "counts", "flat": "."}, ""), ("flat missing", {"kind": "counts",
            "flat": "no.npy"}, "no.npy"),
            ("flat far away", {"kind": "counts", "flat": "/etc/passwd"}, "passwd"),
            ("flat with a null", {"kind": "counts", "flat": "a\0b"}, "flat"),
            ("flat a device", {"kind": "counts", "flat": "/dev/zero"}, "zero"),
            ("flat is a view", {"kind": "counts", "flat": "view_0.npy"}, ""),
            ("flat of 300 letters", {"kind": "counts", "flat": "f" * 300}, "flat"),
            ("dark above air", {"kind": "counts", "air": 5, "dark": 9}, "dark"),
            ("floor 0", {"kind": "counts", "air": 99, "floor": 0}, "floor"),
            ("floor above air", {"kind": "counts", "air": 99, "floor": 1e20}, ""),
            ("display without polarity", {"kind": "display"}, "bright_is_dense"),
            ("polarity 1", {"kind": "display", "bright_is_dense": 1}, "bright_is_dense"),
            ("polarity of counts", {"kind": "counts", "bright_is_dense": True, "air": "1"}, "air")):
        yield f"intensity {name}", no, word, lambda p, block=block: p.predict(p.case(intensity=block))
    for name, block, word in (
            ("-5", {"detector_shift_mm": -5}, "detector_shift_mm"), ("nan", {"gain": float("nan")}, "gain"),
            ("5 mm", {"source_shift_mm": "5 mm"}, "source_shift_mm"), ("1e30", {"offset": 1e30}, "offset"),
            ("a list", ["gain"], "mapping"), ("an unknown key", {"shift": 5}, "shift"), ("empty", {}, "uncertain"),
            ("all zero", {"gain": 0}, "uncertain"), ("1 as a key", {1: 5}, "uncertain")):
        yield f"uncertain {name}", no, ("geometry.yaml", word), lambda p, block=block: p.predict(
            p.case(uncertain=block), "--calibrate")
    vectors = BEAM.to_dict()
    for name, change, word in (
            ("of text", {"sources": "here"}, "sources"), ("one short", {"sources": vectors["sources"][:2]}, ""),
            ("flat lists", {"u": [1, 0, 0]}, "u"), ("ragged", {"u": [[1, 0, 0], [1, 0], [1]]}, "u"),
            ("4 columns", {"v": [[1, 0, 0, 0]] * 3}, "v"), ("tiny steps", {
                "u": [[1e-160, 0, 0]] * 3, "v": [[0, 1e-160, 0]] * 3}, "u"),
            ("steps along each other", {"v": vectors["u"]}, "perpendicular"),
            ("infinite", {"detectors": [[float("inf"), 0, 0]] * 3}, "detectors"),
            ("as text numbers", {"detectors": [["0", "0", "0"]] * 3}, "detectors"),
            ("true", {"detectors": [[True, False, False]] * 3}, "detectors"),
            ("nested deep", {"sources": [[[0, 0, 0]]]}, ""), ("no shape", {"shape": None}, "shape"),
            ("empty", {"sources": [], "detectors": [], "u": [], "v": []}, ""),
            ("null", {"sources": None}, "sources"), ("source at the detector", {"detectors": vectors["sources"]},
            "view"),
            ("far away", {"detectors": [[1e8, 1e8, 1e8]] * 3}, "view"),
            ("a million views", {"sources": [[0, 0, 0]] * 100_000}, "")):
        yield f"vectors {name}", no, ("" if name in ("a million views", "far away") else "geometry.yaml", word), \
            lambda p, change=change: p.predict(p.case(beam=vectors | change))
    yield "vectors as they should be", True, "", lambda p: p.predict(p.case(beam=vectors))
    yield "a beam in a file that is not there", no, "b.csv", lambda p: p.predict(p.case(beam={"file": "b.csv"}))
    yield "a beam in the folder", no, "", lambda p: p.predict(p.case(beam={"file": "."}))
    yield "a beam in itself", no, "", lambda p: p.predict(p.case(beam={"file": "geometry.yaml"}))
    yield "a beam in a number", no, "file", lambda p: p.predict(p.case(beam={"file": 7}))
    yield "a beam by tags of images without", no, "DICOM", lambda p: p.predict(p.case(beam={"dicom": {"pixel": 1}}))
    yield "dicom a list", no, "dicom", lambda p: p.predict(p.case(beam={"dicom": [1]}))
    yield "geometry.yaml is a folder", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), f.mkdir(), p.predict(f.parent))
    yield "geometry.yaml is a dangling link", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), f.symlink_to("nowhere"), p.predict(f.parent))
    yield "geometry.yaml is a pipe", no, "geometry.yaml", lambda p: (
        (f := p.case() / "geometry.yaml").unlink(), os.mkfifo(f), infer(
            ["predict", *SIRT, f"--data.xrays={f.parent}", f"--model.out={p.out}"]))
    yield "a geometry without ending", no, "", lambda p: p.predict(p.case(), f"--data.geometry={p.write('g', good)}")
    yield "an empty geometry option", None, "", lambda p: p.predict(p.case(), "--data.geometry=")
    yield "a geometry option to a folder", no, "", lambda p: p.predict(p.case(), f"--data.geometry={p.given}")


def geometry_files():
    """RTK's XML, ASTRA's vectors and tables."""
    no = False

    def given(name, content):
        def work(p):
            folder = p.case(beam={"file": name, "pixel": [24, 24]})
            p.write(folder / name, content if isinstance(content, str | bytes) else content())
            # images must not take the geometry for a view
            p.predict(folder)
        return work

    def rtk(change=lambda text: text, version="3"):
        rows = "".join(f"<Projection><SourceToIsocenterDistance>740</SourceToIsocenterDistance>"
                       f"<SourceToDetectorDistance>1020</SourceToDetectorDistance><GantryAngle>{a}</GantryAngle>"
                       "</Projection>" for a in (0, 120, 240))
        return change(f'<?xml version="1.0"?><RTKThreeDCircularGeometry version="{version}">{rows}'
                      "</RTKThreeDCircularGeometry>")

    laughs = '<!DOCTYPE l [<!ENTITY a "ha">' + "".join(
        f'<!ENTITY {chr(98 + i)} "{("&" + chr(97 + i) + ";") * 12}">' for i in range(9)) + "]>"
    yield "xml as it should be", True, "", given("g.xml", rtk())
    yield "xml of version 1", no, "version", given("g.xml", rtk(version="1"))
    yield "xml, a billion laughs", no, "g.xml", given("g.xml",
        laughs + "<RTKThreeDCircularGeometry version='3'>&j;</RTKThreeDCircularGeometry>")
    yield "xml that reads files", no, "g.xml", given("g.xml",
        '<!DOCTYPE f [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + rtk(
        lambda t: t.partition("?>")[2].replace(">740<", ">&x;<")))
    yield "xml 5000 deep", no, "g.xml", given("g.xml", "<a>" * 5000)
    yield "xml 200000 deep and closed", no, "g.xml", given("g.xml", "<a>" * 200000 + "</a>" * 200000)
    yield "xml of an unknown encoding", no, "g.xml", given("g.xml", '<?xml version="1.0" encoding="ebcdic-xx"?><a/>')
    yield "xml, an angle of words", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace(">120<", ">right<")))
    yield "xml, an angle of inf", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace(">120<", ">inf<")))
    yield "xml, an angle of 10^4 digits", None, "", given("g.xml", rtk(lambda t: t.replace(">120<",
        ">" + "9" * 10**4 + "<")))
    yield "xml, a distance of 1e200", no, "g.xml", given("g.xml", rtk(lambda t: t.replace(">740<", ">1e200<")))
    yield "xml, without angles", no, "GantryAngle", given("g.xml", rtk(lambda t: t.replace("GantryAngle", "Angle")))
    yield "xml without projections", no, "Projection", given("g.xml", rtk(lambda t: t.replace("Projection", "View")))
    yield "xml, empty", no, "g.xml", given("g.xml", "")
    yield "xml, HTML", no, "g.xml", given("g.xml", "<!doctype html><html><br></html>")
    vectors = np.concatenate([BEAM.sources, BEAM.detectors, BEAM.u, BEAM.v], 1)
    csv = "\n".join(",".join(map(str, row)) for row in vectors)
    yield "csv as it should be", True, "", given("g.csv", csv)
    yield "csv with semicolons and BOM", True, "", given("g.csv", "\ufeff" + csv.replace(",", ";"))
    yield "csv with decimal commas", no, "g.csv", given("g.csv", csv.replace(",", ";").replace(".", ","))
    yield "csv with a short row", no, "g.csv", given("g.csv", csv + "\n1,2,3")
    yield "csv with words", no, "g.csv", given("g.csv", csv.replace("740.0", "seven"))
    yield "csv with nan", no, "g.csv", given("g.csv", csv.replace("740.0", "nan"))
    yield "csv with 1e999", no, "g.csv", given("g.csv", csv.replace("740.0", "1e999"))
    yield "csv with a column twice", None, "", given("g.csv", ",".join(
        f"{v}_{a}" for v in ("source", "detector", "u", "v") for a in "xyz") + ",source_x\n" + csv.replace("\n",
        ",1\n") + ",1")
    yield "csv with half a header", no, "column", given("g.csv", "source_x,source_y\n" + csv)
    yield "csv, empty", no, "g.csv", given("g.csv", "")
    yield "csv, only newlines", no, "g.csv", given("g.csv", "\n\n\n")
    yield "csv, binary", no, "g.csv", given("g.csv", bytes(range(256)) * 10)
    yield "csv of 16 MB in one line", no, "g.csv", given("g.csv", "1," * (2**23 - 1))
    yield "csv of 10^6 lines", no, "", given("g.csv", "0,0,0,0,0,0,0\n" * 10**6)

    def with_npy(content):
        def work(p):
            folder = p.case(beam={"file": "../g.npy"})
            p.write("g.npy", content)
            p.predict(folder)
        return work

    good = vectors.astype("<f8").tobytes()
    yield "npy as it should be", True, "", with_npy(npy("{'descr': '<f8', 'fortran_order': False, 'shape': (3, 12), }",
        good))
    yield "npy of objects", no, "g.npy", with_npy(npy("{'descr': '|O', 'fortran_order': False, 'shape': (3, 12), }",
        PICKLE))
    yield "npy with a shape below 0", no, "g.npy", with_npy(npy(
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 12), }", good))
    yield "npy with code in its header", no, "g.npy", with_npy(npy(
        "{'descr': __import__('os').system('touch pwned'), 'fortran_order': False, 'shape': (3, 12), }", good))
    yield "npy with 10^5 brackets", no, "g.npy", with_npy(npy("(" * 60000, good))
    yield "npy of type 1e9 letters", no, "g.npy", with_npy(npy(
        "{'descr': '<U1000000000', 'fortran_order': False, 'shape': (), }"))
    yield "npy of version 9", no, "g.npy", with_npy(b"\x93NUMPY\x09\x00" + good)
    yield "npy, 5 bytes", no, "g.npy", with_npy(b"\x93NUMP")
    yield "npy of complex numbers", no, "g.npy", with_npy(npy(
        "{'descr': '<c16', 'fortran_order': False, 'shape': (3, 6), }", good))
    yield "npy with no numbers of 10^18 rows", no, "g.npy", with_npy(npy(
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000000, 0), }"))
    yield "npy of records", no, "g.npy", with_npy(npy(
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (36,), }", good))
