"""Other programs' geometry files: what is written is read back, and their axes mean what their documentation says."""

from __future__ import annotations

import os
import re
from dataclasses import replace

import numpy as np
import pytest

from phydict.xray import ConeBeam
from phydict.xray.geometry_files import COLUMNS, read_beam, write_beam
from phydict.xray.rtk import write_rtk

SHAPE, PIXEL = (6, 8), (2.0, 3.0)
ENDINGS = ("yaml", "xml", "npy", "csv")


def orbit(views=5):
    return ConeBeam.orbit(views, 1020, 740, SHAPE, PIXEL, start=0.3)


def random_poses(views=4, seed=0):
    """Detectors of any orientation, sources off their axes; u x v points to the source."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(views, 3, 3)))[0]
    normals = np.cross(axes[:, 0], axes[:, 1])
    return ConeBeam(700 * normals + rng.normal(0, 30, (views, 3)), -300 * normals + rng.normal(0, 30, (views, 3)),
                    PIXEL[1] * axes[:, 0], PIXEL[0] * axes[:, 1], SHAPE)


def along_the_axis():
    """A source straight above the head: RTK's angles then turn about one and the same axis."""
    return ConeBeam([[0, 0, 700]], [[0, 0, -300]], [[-2.4, 1.8, 0]], [[-1.2, -1.6, 0]], SHAPE)


def rtk(tmp_path, views, head="<SourceToIsocenterDistance>740</SourceToIsocenterDistance>"
        "<SourceToDetectorDistance>1020</SourceToDetectorDistance>", version=3, root="RTKThreeDCircularGeometry"):
    path = tmp_path / "geometry.xml"
    path.write_text(f'<?xml version="1.0"?><!DOCTYPE RTKGEOMETRY><{root} version="{version}">{head}'
                    + "".join(f"<Projection>{view}</Projection>" for view in views) + f"</{root}>")
    return path


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("make", [orbit, random_poses, along_the_axis])
def test_what_is_written_is_read_back(tmp_path, make, ending):
    write_beam(tmp_path / f"beam.{ending}", make())
    assert read_beam(tmp_path / f"beam.{ending}", SHAPE, PIXEL).same_as(make(), tolerance=1e-9)


def test_a_table_of_numpys_has_its_columns_by_the_names_in_its_header(tmp_path):
    write_beam(tmp_path / "beam.csv", random_poses())
    lines = (tmp_path / "beam.csv").read_text().splitlines()
    columns = np.array([line.split(",") for line in lines if not line.startswith("#")]).T[::-1]
    assert columns[0, 0] == COLUMNS[-1]
    np.savetxt(tmp_path / "numpy.csv", columns[:, 1:].T.astype(float), delimiter=",", header=",".join(columns[:, 0]))
    assert read_beam(tmp_path / "numpy.csv", SHAPE, PIXEL).same_as(random_poses(), tolerance=1e-9)
    table, comment = "\n".join(",".join(row) for row in columns.T), "# source_x, source_y and source_z in mm"
    named = "# " + table.partition("\n")[0]
    for text in (f"{comment}\n{table}\n{comment}\n{named}", f"{named}\n{table}"):
        (tmp_path / "commented.csv").write_text(text)
        assert read_beam(tmp_path / "commented.csv", SHAPE, PIXEL).same_as(random_poses(), tolerance=1e-9)


@pytest.mark.parametrize("continued", [True, False])
def test_yaml_holds_whether_the_patient_goes_on_and_other_files_warn_that_they_do_not(tmp_path, continued):
    beam = replace(orbit(), continued=continued)
    write_beam(tmp_path / "beam.yaml", beam)
    assert read_beam(tmp_path / "beam.yaml").continued is continued
    for ending in ENDINGS[1:]:
        with pytest.warns(UserWarning, match=f"beam.{ending} cannot say .*`continued: {str(continued).lower()}`"):
            write_beam(tmp_path / f"beam.{ending}", beam)
        assert read_beam(tmp_path / f"beam.{ending}", SHAPE, PIXEL).continued is None


@pytest.mark.parametrize("ending", ENDINGS)
def test_writing_that_fails_leaves_the_old_file(tmp_path, monkeypatch, ending):
    write_beam(tmp_path / f"beam.{ending}", orbit())
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("No space left on device")))
    with pytest.raises(OSError, match="No space"):
        write_beam(tmp_path / f"beam.{ending}", random_poses())
    assert read_beam(tmp_path / f"beam.{ending}", SHAPE, PIXEL).same_as(orbit())
    assert [file.name for file in tmp_path.iterdir()] == [f"beam.{ending}"]


def test_rtk_gantry_angles_follow_iec_61217_for_a_supine_patient(tmp_path):
    views = [f"<GantryAngle>{angle}</GantryAngle>" for angle in (0, 90, 180, 270)]
    beam = read_beam(rtk(tmp_path, views), SHAPE, PIXEL)
    anterior, left, posterior, right = [0, 740, 0], [-740, 0, 0], [0, -740, 0], [740, 0, 0]
    np.testing.assert_allclose(beam.sources, [anterior, left, posterior, right], atol=1e-9)
    np.testing.assert_allclose(beam.detectors, -280 / 740 * beam.sources, atol=1e-9)
    np.testing.assert_allclose(beam.v, [[0, 0, 2]] * 4, atol=1e-12)  # y, and with it the row, grows to superior
    np.testing.assert_allclose(beam.u[0], [-3, 0, 0], atol=1e-12)  # x grows to the patient's left


def test_rtk_offsets_move_source_and_detector_along_the_turned_axes(tmp_path):
    moved = ("<SourceOffsetX>5</SourceOffsetX><SourceOffsetY>7</SourceOffsetY>"
             "<ProjectionOffsetX>11</ProjectionOffsetX><ProjectionOffsetY>13</ProjectionOffsetY>")
    beam = read_beam(rtk(tmp_path, ["<GantryAngle>90</GantryAngle>" + moved]), SHAPE, PIXEL)
    np.testing.assert_allclose(beam.sources, [[-740, -5, 7]], atol=1e-9)  # from the left, x grows to posterior
    np.testing.assert_allclose(beam.detectors, [[280, -11, 13]], atol=1e-9)


def test_rtk_tilts_keep_the_distances_and_follow_their_signs(tmp_path):
    beam = read_beam(rtk(tmp_path, ["<GantryAngle>0</GantryAngle><OutOfPlaneAngle>30</OutOfPlaneAngle>",
                                    "<GantryAngle>0</GantryAngle><OutOfPlaneAngle>0</OutOfPlaneAngle>"
                                    "<InPlaneAngle>90</InPlaneAngle>"]), SHAPE, PIXEL)
    np.testing.assert_allclose(beam.sources[0], [0, 740 * np.cos(np.pi / 6), -370], atol=1e-9)
    np.testing.assert_allclose(beam.u[1], [0, 0, 3], atol=1e-12)  # columns now run to superior
    np.testing.assert_allclose(beam.distances, 1020)


def test_rtk_keeps_a_value_until_the_next_one_is_given(tmp_path):
    beam = read_beam(rtk(tmp_path, ["<GantryAngle>0</GantryAngle><SourceOffsetY>9</SourceOffsetY>",
                                    "<GantryAngle>90</GantryAngle>"]), SHAPE, PIXEL)
    np.testing.assert_allclose(beam.sources[:, 2], 9)


def test_rtks_matrix_sends_points_to_the_pixels_that_see_them(tmp_path):
    """RTK refuses a file whose <Matrix> contradicts its parameters."""
    beam = random_poses(1)
    write_beam(tmp_path / "beam.xml", beam)
    text = re.search("<Matrix>(.*?)</Matrix>", (tmp_path / "beam.xml").read_text(), re.S).group(1)
    matrix = np.array(text.split(), float).reshape(3, 4)
    for row, column in ((0, 0), (5, 2)):
        point = 0.4 * beam.sources[0] + 0.6 * beam.pixels()[0, row, column]
        x, y, w = matrix @ np.append(point[[0, 2, 1]] * [-1, 1, 1], 1)
        np.testing.assert_allclose([x / w, y / w], [(column - 3.5) * 3, (row - 2.5) * 2], atol=1e-9)


def test_astra_vectors_are_source_detector_u_v(tmp_path):
    beam = random_poses()
    rows = np.concatenate([beam.sources, beam.detectors, beam.u, beam.v], 1)
    np.save(tmp_path / "cone.npy", rows)
    np.savetxt(tmp_path / "cone.csv", rows, delimiter=",")
    np.savetxt(tmp_path / "cone.txt", rows)
    for name in ("cone.npy", "cone.csv", "cone.txt"):
        assert read_beam(tmp_path / name, SHAPE).same_as(beam, 1e-9)


def test_named_columns_come_in_any_order(tmp_path):
    beam = orbit(3)
    rows = np.concatenate([beam.sources, beam.detectors, beam.u, beam.v], 1)
    order = np.random.default_rng(0).permutation(12)
    header = ",".join(["view", *(COLUMNS[i].upper() for i in order)])
    lines = [",".join(map(str, [k, *row[order]])) for k, row in enumerate(rows)]
    (tmp_path / "views.csv").write_text("\n".join([header, *lines]))
    assert read_beam(tmp_path / "views.csv", SHAPE).same_as(beam, 1e-9)


@pytest.mark.parametrize("separator, quote, names", [
    (",", '"', None), (",", "'", None), (" ", '"', None),
    (",", "", [",", "0,", "1,", "2,"]), (",", '"', ['"",', '"1",', '"2",', '"3",']),
    ("\t", "", ["", "0\t", "1\t", "2\t"]), (" ", '"', ["", '"1" ', '"2" ', '"3" ']),
    (",", '"', ["number,name,", '1,"first",', "2,second,", "3,,"])],
    ids=["quotes", "single quotes", "spaces", "pandas", "R", "pandas, tabs", "R, spaces", "other columns"])
def test_a_table_of_another_program_is_read_by_its_names(tmp_path, separator, quote, names):
    rows = np.concatenate([orbit(3).sources, orbit(3).detectors, orbit(3).u, orbit(3).v], 1)
    lines = [separator.join(f"{quote}{name}{quote}" for name in COLUMNS),
             *(separator.join(map(repr, row.tolist())) for row in rows)]
    text = "\n".join(name + line for name, line in zip(names or [""] * 4, lines))
    (tmp_path / "views.csv").write_text(text)
    assert read_beam(tmp_path / "views.csv", SHAPE).same_as(orbit(3), 1e-9)


@pytest.mark.parametrize("separator", [";", "\t", "; "])
@pytest.mark.parametrize("header", [True, False])
def test_decimal_commas_are_told_as_such(tmp_path, separator, header):
    write_beam(tmp_path / "a.csv", orbit(3))
    lines = (tmp_path / "a.csv").read_text().replace(",", separator).replace(".", ",").splitlines()
    (tmp_path / "a.csv").write_text("\n".join(lines[0 if header else 1:]))
    with pytest.raises(ValueError, match="a.csv: view 0 has decimal commas; write its numbers with decimal points"):
        read_beam(tmp_path / "a.csv", SHAPE)


@pytest.mark.parametrize("views, options, sentence", [
    (["<GantryAngle>0</GantryAngle>"], {"head": ""}, "no SourceToIsocenterDistance, SourceToDetectorDistance"),
    (["<GantryAngle>0</GantryAngle><SourceToDetectorDistance>0</SourceToDetectorDistance>"], {},
     "SourceToDetectorDistance 0 mm, but both must be positive"),
    (["<GantryAngle>left</GantryAngle>"], {}, "<GantryAngle> must hold a number, but 'left'"),
    (["<GantryAngle>nan</GantryAngle>"], {}, "finite"),
    (["<RadiusCylindricalDetector>900</RadiusCylindricalDetector>"], {}, "cylindrical detector"),
    ([], {}, "holds no <Projection>"),
    (["<GantryAngle>0</GantryAngle>"], {"version": 1}, "of version 2 or 3 was expected"),
    (["<GantryAngle>0</GantryAngle>"], {"root": "Reg23"}, "holds <Reg23"),
])
def test_a_bad_rtk_file_is_explained(tmp_path, views, options, sentence):
    with pytest.raises(ValueError, match=f"geometry.xml.*{sentence}"):
        read_beam(rtk(tmp_path, views, **options), SHAPE, PIXEL)


def test_a_mirrored_beam_cannot_become_rtk(tmp_path):
    beam = orbit(2)
    mirrored = ConeBeam(beam.sources, beam.detectors, -beam.u, beam.v, SHAPE)
    with pytest.raises(ValueError, match="view 0: u x v points away from the source.*flip their columns"):
        write_beam(tmp_path / "beam.xml", mirrored)


@pytest.mark.parametrize("write", [write_beam, write_rtk])
def test_a_beam_and_a_path_in_each_others_place_are_told_their_order(tmp_path, write):
    with pytest.raises(ValueError, match=rf"the beam first; call {write.__name__}\(path, beam\)"):
        write(orbit(), tmp_path / "beam.xml")
    with pytest.raises(ValueError, match="a path and then a ConeBeam, but was given 3"):
        write(tmp_path / "beam.xml", 3)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name, text, sentence", [
    ("a.csv", "source_x,source_y\n1,2\n", "no column source_z, detector_x"),
    ("a.csv", "1,2,3\n", "view 0 has 3 values, but 12"),
    ("a.csv", ",".join(COLUMNS) + "\n" + ",".join(["7"] * 13), "view 0 has 13 values, but 12"),
    ("a.csv", ",".join(["1"] * 11 + ["many"]), "'many'"),
    ("a.csv", "", r"shape \(0, 12\), but 12 per view"),
    ("a.csv", ",".join(["0"] * 12), "one of 0 mm"),
    ("a.csv", ",".join(["1"] + ["nan"] * 11), "sources must be finite"),
    ("a.npy", "hello", "cannot be read .*numpy.save"),
    ("a.xml", "<RTK", "is not valid XML"),
    ("a.json", "{}", "its name must end in one of .yaml"),
])
def test_a_bad_table_is_explained(tmp_path, name, text, sentence):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}.*{sentence}"):
        read_beam(tmp_path / name, SHAPE, PIXEL)


@pytest.mark.parametrize("pixel", [(2.0, -3.0), 0.0, "small"])
def test_an_impossible_pixel_size_is_refused(tmp_path, pixel):
    write_beam(tmp_path / "beam.xml", orbit())
    with pytest.raises(ValueError, match="pixel must be .row height, column width."):
        read_beam(tmp_path / "beam.xml", SHAPE, pixel)


def test_what_a_file_does_not_say_must_be_stated(tmp_path):
    write_beam(tmp_path / "beam.xml", orbit())
    with pytest.raises(ValueError, match="how many pixels.*`shape`"):
        read_beam(tmp_path / "beam.xml")
    with pytest.raises(ValueError, match="how large the pixels are.*`pixel`"):
        read_beam(tmp_path / "beam.xml", SHAPE)
    with pytest.raises(FileNotFoundError, match="no geometry file .*absent.csv"):
        read_beam(tmp_path / "absent.csv", SHAPE)


@pytest.mark.parametrize("file", ["beam.npy", "beam.csv", "beam.yaml"])
def test_pixels_that_are_not_those_of_a_files_own_vectors_are_refused(tmp_path, file):
    write_beam(tmp_path / file, orbit())
    assert read_beam(tmp_path / file, SHAPE, PIXEL).same_as(orbit())
    with pytest.raises(ValueError, match=rf"{file}: its v and u state pixels of \[.*\] mm, but `pixel` 7.5 was given"):
        read_beam(tmp_path / file, SHAPE, 7.5)
    for wrong in ("small", (1.0, 2.0, 3.0), -1.0):
        with pytest.raises(ValueError, match=f"{file}: pixel must be .row height, column width."):
            read_beam(tmp_path / file, SHAPE, wrong)
