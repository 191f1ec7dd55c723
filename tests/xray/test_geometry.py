"""Where sources, detectors and pixels are, and what impossible geometry is told."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from phydict.xray import ConeBeam, Grid
from phydict.xray.checks import check_meets, check_scale

ORBIT = """orbit:
  views: 4
  source_to_detector: 1020
  source_to_isocentre: 740
  shape: [112, 96]
  pixel: [5, 4]
"""


def orbit(views=4, shape=(112, 96), pixel=(5.0, 4.0), **angles):
    return ConeBeam.orbit(views, 1020, 740, shape, pixel, **angles)


def vectors(**changes):
    return {**orbit(2, (4, 4)).to_dict(), **changes}


def test_first_view_is_pa_and_second_of_four_comes_from_the_left():
    beam = orbit()
    np.testing.assert_allclose(beam.sources, [[0, -740, 0], [-740, 0, 0], [0, 740, 0], [740, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(beam.detectors, [[0, 280, 0], [280, 0, 0], [0, -280, 0], [-280, 0, 0]], atol=1e-9)
    first = beam.pixels()[0, 0, 0]
    np.testing.assert_allclose(first, [95 / 2 * 4, 280, 111 / 2 * 5])  # patient's right, superior
    np.testing.assert_allclose(beam.pixels()[1, 0, -1], [280, 95 / 2 * 4, 111 / 2 * 5])  # anterior at the image's right


def test_start_and_arc_place_the_same_views():
    full = orbit(8)
    assert orbit(4, start=np.pi, arc=np.pi).same_as(full.select(slice(4, 8)))
    assert full.select([6, 1]).same_as(full.select([6]).select([0])) is False
    assert full.select(np.arange(8) % 2 == 0).same_as(orbit(4))
    for views in ([8], "a", np.arange(3) > 0):
        with pytest.raises(ValueError, match="views are indices below 8, a slice or a mask, but"):
            full.select(views)


def test_angles_are_taken_in_degrees_or_radians_but_not_in_both():
    assert orbit(4, start_degrees=180, arc_degrees=90).same_as(orbit(4, start=np.pi, arc=np.pi / 2))
    with pytest.raises(ValueError, match="start=1 .radians. and start_degrees=60 were both given"):
        orbit(4, start=1, start_degrees=60)


@pytest.mark.parametrize("angle", ["start", "arc"])
def test_degrees_given_as_radians_are_refused_with_the_name_of_degrees(angle):
    with pytest.raises(ValueError, match=f"{angle} is in radians, but 90 .* give {angle}_degrees"):
        orbit(4, **{angle: 90})


def test_a_view_alone_needs_no_arc():
    assert orbit(1, arc_degrees=0).same_as(orbit(1)) and orbit(2, arc_degrees=-0.01).views == 2


def pixel_of(beam, point):
    """Row and column (K, 2) in pixels from the detectors' centres at which a world point is seen."""
    ray = np.asarray(point, float) - beam.sources
    hit = beam.sources + ray * (beam.distances / (ray * beam.normals).sum(1))[:, None] - beam.detectors
    return np.stack([(hit * step).sum(1) / (step ** 2).sum(1) for step in (beam.v, beam.u)], 1)


def test_views_at_given_angles_are_those_of_an_orbit():
    beam = ConeBeam.at_angles([270, 0, 90], 1020, 740, (112, 96), (5.0, 4.0))
    assert beam.same_as(orbit().select([3, 0, 1]))


def test_a_shifted_detector_sees_the_isocentre_as_far_the_other_way():
    np.testing.assert_allclose(pixel_of(orbit().shifted(rows=10.0, columns=60.0), [0, 0, 0]),
                               np.tile([-10 / 5, -60 / 4], (4, 1)), atol=1e-12)


@pytest.mark.parametrize("degrees", [15.0, -40.0])
def test_a_tilted_view_looks_at_the_isocentre_from_as_far_and_from_above(degrees):
    beam = orbit().tilted(degrees)
    np.testing.assert_allclose(beam.sources[:, 2], 740 * np.sin(np.radians(degrees)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(beam.sources, axis=1), 740)
    np.testing.assert_allclose(beam.distances, 1020)
    np.testing.assert_allclose(pixel_of(beam, [0, 0, 0]), 0, atol=1e-9)
    assert orbit().tilted(degrees).tilted(-degrees).same_as(orbit())


def test_a_sweep_moves_the_source_evenly_along_the_patient_before_a_resting_detector():
    beam = ConeBeam.sweep(5, 1020, 740, (112, 96), (5.0, 4.0), 40)
    assert beam.select([2]).same_as(orbit().select([0]))
    angles = np.degrees(np.arctan2(beam.sources[:, 2], -beam.sources[:, 1]))
    np.testing.assert_allclose(angles[[0, -1]], [-20, 20])
    np.testing.assert_allclose(np.ptp(np.diff(beam.sources[:, 2])), 0, atol=1e-9)
    np.testing.assert_allclose(np.ptp(beam.detectors, axis=0), 0)
    rows = pixel_of(beam, [0, 100, 0])[:, 0]  # what lies before the detector moves down as the source rises
    assert (np.diff(rows) > 0).all()


@pytest.mark.parametrize("make, degrees", [
    (lambda: orbit(4, arc_degrees=2 * np.pi), 360), (lambda: orbit(2, arc_degrees=-np.pi), 180),
    (lambda: ConeBeam.at_angles([0, 1.571], 1020, 740, (8, 8), 5.0), 90),
    (lambda: ConeBeam.sweep(5, 1020, 740, (8, 8), 5.0, 0.698), 40)])
def test_degrees_that_are_radians_are_warned_of(make, degrees):
    with pytest.warns(UserWarning, match=f"_degrees, too near .* in radians, they are {degrees} degrees"):
        make()


def test_binned_pixels_are_the_means_of_their_blocks():
    beam = orbit()
    blocks = beam.pixels().reshape(4, 28, 4, 24, 4, 3).mean((2, 4))
    np.testing.assert_allclose(beam.binned(4).pixels(), blocks, atol=1e-9)
    within = beam.pixels()[:, 1:-1, :-1].reshape(4, 22, 5, 19, 5, 3).mean((2, 4))  # of 112 and 96, 110 and 95
    np.testing.assert_allclose(beam.binned(5).pixels(), within, atol=1e-9)
    for factor in (0, 1.5, 97):
        with pytest.raises(ValueError, match=f"112 x 96 pixels cannot be binned by {factor}; .* from 1 to 96"):
            beam.binned(factor)


def test_distances_are_perpendicular_to_the_detector():
    beam = orbit()
    shifted = ConeBeam(beam.sources + 30 * beam.v, beam.detectors, beam.u, beam.v, beam.shape)
    np.testing.assert_allclose(shifted.distances, 1020)


@pytest.mark.parametrize("changes, sentence", [
    ({"u": [[1e-160, 0, 0]] * 2, "v": [[0, 0, -1e-160]] * 2}, "at least 1e-06 mm long"),
    ({"sources": [[0, 0, 0]]}, "1 sources, but 2 rows in detectors"),
    ({"u": [[1, 0], [1, 0]]}, r"u must be \(views, 3\)"),
    ({"detectors": [[0, float("nan"), 0], [0, 1, 0]]}, "detectors must be finite"),
    ({"v": [[0, 0, 0], [0, 0, 1]]}, "one of 0 mm"),
    ({"u": [[-4, 0, 1], [4, 0, 0]]}, "view 0: u must be perpendicular to v"),
    ({"sources": [[10, 280, 0], [0, 740, 0]]}, "view 0: the source lies in the plane"),
    ({"shape": [4]}, "two positive sizes"),
    ({"shape": [4, 0]}, "two positive sizes"),
])
def test_bad_vectors_are_refused_with_a_reason(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        ConeBeam(**vectors(**changes))


@pytest.mark.parametrize("arguments, sentence", [
    ((0, 1020, 740, (4, 4), 1), "at least one view"),
    ((2, 740, 1020, (4, 4), 1), "must lie between source and detector"),
    ((2, 1020, 740, (4, 4), (1, 0)), "row height, column width"),
    ((2, 1020, 740, (4, 4), 1, 0.0, 0.0), "an orbit of 2 views .* one of 0 degrees, .* leave the arc out"),
    ((3, 1020, 740, (4, 4), 1, 0.0, -1e-5), "an orbit of 3 views .* one of -0.000572958 degrees"),
])
def test_bad_orbits_are_refused_with_a_reason(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        ConeBeam.orbit(*arguments)


@pytest.mark.parametrize("make, sentence", [
    (lambda: ConeBeam.orbit(8, "1020", 740, (3, 3), 1), "source_to_detector is a number .* but '1020' was given"),
    (lambda: ConeBeam.orbit(8, None, 740, (3, 3), 1), "source_to_detector is a number .* but None was given"),
    (lambda: ConeBeam.orbit(8, 1020, [740], (3, 3), 1), "source_to_isocentre is one number, but .740. was given"),
    (lambda: orbit(start_degrees="9"), "start_degrees is a number .* but '9' was given"),
    (lambda: orbit(arc="9"), "arc is a number .* but '9' was given"),
    (lambda: ConeBeam.at_angles([0, 90], 1020, "740", (3, 3), 1), "source_to_isocentre is a number .* but '740'"),
    (lambda: ConeBeam.sweep(8, 1020, 740, (3, 3), 1, "40"), "sweep_degrees is a number .* but '40' was given"),
    (lambda: orbit().tilted("5"), "tilt_degrees is a number .* but '5' was given"),
    (lambda: orbit().shifted(None), "rows is a number .* but None was given")])
def test_text_and_nothing_in_the_place_of_a_number_are_named(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()


def test_a_detector_inside_the_volume_is_refused_with_both_distances():
    beam = ConeBeam.orbit(1, 1020, 950, (8, 8), 1)
    with pytest.raises(ValueError, match=r"detector lies inside.*950\.0 mm.*70\.0 mm.*reaches 128\.0 mm"):
        beam.check(Grid.cube(16, 256))
    beam.check(Grid.cube(16, 138))
    with pytest.raises(ValueError, match="view 1: the detector"):  # the corner reaches 97.6 mm at 45 degrees
        ConeBeam.orbit(8, 1020, 950, (8, 8), 1).check(Grid.cube(16, 138))


def test_a_source_inside_or_beside_the_volume_is_refused():
    beam = ConeBeam.orbit(1, 500, 100, (8, 8), 1)
    with pytest.raises(ValueError, match=r"source lies inside.*100\.0 mm.*400\.0 mm"):
        beam.check(Grid.cube(16, 256))


def test_a_tilted_orbit_is_told_which_source_distances_would_do():
    def tilted(to_isocentre: float) -> ConeBeam:
        beam, angle = ConeBeam.orbit(8, 1020, to_isocentre, (448, 448), 1.25), np.radians(15)
        turn = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
        return ConeBeam(*(vectors @ turn for vectors in (beam.sources, beam.detectors, beam.u, beam.v)), beam.shape)

    with pytest.raises(ValueError, match="source_to_isocentre of 303 to 717 mm would do .* 1020 mm"):
        tilted(740).check(Grid.cube(64))
    for distance in (303, 717):
        tilted(distance).check(Grid.cube(64))
    for distance in (300, 720):
        with pytest.raises(ValueError, match="303 to 717"):
            tilted(distance).check(Grid.cube(64))
    with pytest.raises(ValueError, match="no source_to_isocentre would do, since 544 mm"):
        ConeBeam.orbit(8, 500, 250, (448, 448), 1.25).check(Grid.cube(64))


def test_the_default_geometry_clears_its_volume():
    ConeBeam.orbit(8, 1020, 740, (448, 448), 1.25).check(Grid.cube(64))


@pytest.mark.parametrize("lengths", [(1.02, 0.74, 0.00125), (1020, 74, 1.25)], ids=["all", "as matrices of cm do"])
def test_lengths_in_m_and_cm_are_told_of(lengths):
    to_detector, to_isocentre, pixel = lengths
    with pytest.raises(ValueError, match="lengths in mm, not in cm or m"):
        ConeBeam.orbit(8, to_detector, to_isocentre, (448, 448), pixel).check(Grid.cube(64))


def test_yaml_round_trip_keeps_every_pose(tmp_path):
    tilted = ConeBeam([[3, -700, 20]], [[1, 300, 4]], [[-2, 0.1, 0]], [[0.1, 2, -3]], (5, 6))
    for beam in (tilted, orbit(3, start=0.1)):
        beam.save(tmp_path / "beam.yaml")
        assert ConeBeam.load(tmp_path / "beam.yaml").same_as(beam, tolerance=0)


def test_yaml_orbit_is_read_in_degrees(tmp_path):
    path = tmp_path / "beam.yaml"
    path.write_text(ORBIT)
    assert ConeBeam.load(path).same_as(orbit())
    inner = "".join(f"  {line}\n" for line in ORBIT.splitlines())
    path.write_text(f"intensity: {{kind: line_integrals}}\nbeam:\n{inner}")
    assert ConeBeam.load(path).same_as(orbit())  # a case's geometry.yaml
    path.write_text(ORBIT + "  start_degrees: 90\n  arc_degrees: 180\n")
    assert ConeBeam.load(path).same_as(orbit(start=np.pi / 2, arc=np.pi))
    path.write_text(ORBIT + f"  start: {np.pi / 2}\n  arc: {np.pi}\n")
    assert ConeBeam.load(path).same_as(orbit(start=np.pi / 2, arc=np.pi))


def test_yaml_holds_angles_sweeps_shifts_and_tilts(tmp_path):
    path, place = tmp_path / "beam.yaml", "  detector_shift: 30\n  tilt_degrees: 10\n"
    path.write_text(ORBIT + place)
    assert ConeBeam.load(path).same_as(orbit().shifted(columns=30).tilted(10))
    path.write_text(ORBIT.replace("views: 4", "angles_degrees: [3, 50]") + "  detector_shift: [5, -30]\n")
    assert ConeBeam.load(path).same_as(ConeBeam.at_angles([3, 50], 1020, 740, (112, 96), (5, 4)).shifted(5, -30))
    path.write_text(ORBIT.replace("orbit", "sweep") + "  sweep_degrees: 40\n")
    assert ConeBeam.load(path).same_as(ConeBeam.sweep(4, 1020, 740, (112, 96), (5, 4), 40))


@pytest.mark.parametrize("within, beside", [(None, None), (None, True), (None, False), (True, None), (False, False)])
def test_yaml_says_in_the_beam_or_beside_it_whether_the_patient_goes_on(tmp_path, within, beside):
    path = tmp_path / "geometry.yaml"
    path.write_text(yaml.safe_dump({"beam": vectors(continued=within), "continued": beside}))
    assert ConeBeam.load(path).continued is (beside if within is None else within)


@pytest.mark.parametrize("within, beside, sentence", [
    (True, False, "`continued` is True in `beam:`, but False beside it"),
    (False, True, "`continued` is False in `beam:`, but True beside it"), (None, 1, "continued is true or false")])
def test_yaml_that_contradicts_itself_on_whether_the_patient_goes_on_is_refused(tmp_path, within, beside, sentence):
    path = tmp_path / "geometry.yaml"
    path.write_text(yaml.safe_dump({"beam": vectors(continued=within), "continued": beside}))
    with pytest.raises(ValueError, match=rf"geometry\.yaml: .*{sentence}"):
        ConeBeam.load(path)


def test_a_patient_who_goes_on_and_one_who_ends_are_not_seen_alike():
    goes_on, ends = (replace(orbit(), continued=said) for said in (True, False))
    assert not goes_on.same_as(ends) and not ends.same_as(goes_on)
    assert goes_on.same_as(goes_on) and goes_on.same_as(orbit()) and orbit().same_as(ends)


@pytest.mark.parametrize("text, sentence", [
    (ORBIT + "  angles_degrees: [1, 2]\n", "unknown key 'views'; the keys are angles_degrees"),
    (ORBIT.replace("views: 4", "angles_degrees: []"), "an angle for each view"),
    (ORBIT.replace("views: 4", "angles_degrees: 3"), "an angle for each view"),
    (ORBIT + "  detector_shift: [1, 2, 3]\n", "detector_shift is mm"),
    (ORBIT + "  tilt_degrees: 90\n", "between -90 and 90"),
    (ORBIT.replace("orbit", "sweep"), "missing key 'sweep_degrees'"),
    (ORBIT.replace("orbit", "sweep") + "  sweep_degrees: 170\n", r"in \(0, 160\]"),
    (ORBIT.replace("orbit", "sweep").replace("views: 4", "views: 1") + "  sweep_degrees: 17\n", "two views or more"),
    (ORBIT + "  angle: 3\n", "unknown key 'angle'; .* start_degrees, arc_degrees"),
    (ORBIT + "  start: 90\n", "give start_degrees"),
    (ORBIT + "  arc_degrees: 0\n", "an orbit of 4 views has an arc"),
    (ORBIT.replace("  views: 4\n", ""), "missing key 'views'"),
    (ORBIT + "shape: [1, 1]\n", "unknown key 'shape'"),
    ("orbits: {views: 8}\n", "unknown key 'orbits'; the keys are sources, .*, or orbit or sweep in their place"),
    (ORBIT.replace("740", "2000"), "must lie between"),
    (ORBIT.replace("740", "far"), ""),
    ("sources: [[0, -1, 0]]\n", "missing key 'detectors'"),
    ("orbit: 3\n", "a mapping with the keys views"),
    ("- 1\n", "a mapping with the keys sources"),
    ("{", "not valid YAML"),
])
def test_bad_yaml_names_the_file_and_the_key(tmp_path, text, sentence):
    path = tmp_path / "beam.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"beam\.yaml.*{sentence}"):
        ConeBeam.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no geometry file .*nowhere.yaml"):
        ConeBeam.load(tmp_path / "nowhere.yaml")


def test_a_volume_in_scale_with_its_detector_passes_without_a_word(recwarn):
    for beam in (orbit(), orbit(pixel=(2.5, 2)), ConeBeam.orbit(4, 1020, 740, (1, 448), 1.25)):  # one is a fan beam
        check_scale(beam, Grid.cube(64))
    assert not recwarn.list


@pytest.mark.parametrize("factor, comparison", [(10, "smaller"), (0.1, "larger"), (1000, "smaller")])
def test_pixels_in_another_unit_are_refused_by_their_factor(factor, comparison):
    side = 384 * 1020 / (740 - 192)  # of the shadow, which the box's near face casts
    beam = orbit(pixel=(side / 112 * factor, side / 96 * factor))
    with pytest.raises(ValueError, match=f"view 0: .* times {comparison} than the detector.*in mm") as caught:
        check_scale(beam, Grid.cube(64))
    said = float(str(caught.value).split(" times")[0].split()[-1])
    assert said == pytest.approx(max(factor, 1 / factor), rel=0.01)


def test_distances_in_another_unit_are_refused():
    beam = ConeBeam.orbit(2, 10200, 7400, (112, 112), 0.5)
    with pytest.raises(ValueError, match="times larger than the detector of 56 x 56 mm"):
        check_scale(beam, Grid.cube(64))


def test_a_small_field_of_view_is_a_warning():
    with pytest.warns(UserWarning, match="view 0: the volume's shadow is 5.3 times larger"):
        check_scale(orbit(pixel=(1.2, 1.4)), Grid.cube(64))


def test_a_view_that_misses_the_volume_is_refused():
    beam = orbit()
    beside = ConeBeam(beam.sources, beam.detectors + [[0, 0, 0], [0, 0, 900], [0, 0, 0], [0, 0, 0]], beam.u, beam.v,
                      beam.shape)
    with pytest.raises(ValueError, match="view 1: no ray .* meets the volume"):
        check_scale(beside, Grid.cube(64))


@pytest.mark.parametrize("axis, half", [(0, 192 * 836 / 1020), (2, 280 * 836 / 1020)])  # seen 96 mm behind its centre
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_box_is_met_where_a_view_sees_a_part_of_it(axis, half, sign):
    def box(beyond: float) -> Grid:
        return Grid.box(8, 192.0, np.eye(3)[axis] * sign * (half + 96 + beyond))

    beam = orbit(1)
    check_meets(beam, box(-0.1))
    with pytest.raises(ValueError, match=r"no ray of any view meets the box .* \(192, 192, 192\) mm"):
        check_meets(beam, box(0.1))
    check_meets(orbit(2, arc_degrees=180), box(0.1) if axis == 0 else box(-0.1))  # the second view sees it
