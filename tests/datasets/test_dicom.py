"""DICOM X-rays: tags give the beam that PS3.3 describes, values mean what their tags say, gaps are named."""

from __future__ import annotations

import re

import numpy as np
import pydicom
import pytest
import torch
import yaml
from dicom_files import orbit_tags, write_dicom
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

from phydict.datasets.intensity import Intensity
from phydict.datasets.radiographs.radiographs import find_xrays, load_xrays
from phydict.xray.geometry import ConeBeam

SHAPE, PIXEL = (6, 5), (70.0, 80.0)
XA = {"DistanceSourceToDetector": 1020.0, "DistanceSourceToPatient": 740.0, "ImagerPixelSpacing": list(PIXEL)}
DX = {"DistanceSourceToDetector": 1800.0, "EstimatedRadiographicMagnificationFactor": 1.2,
      "DistanceSourceToPatient": 1750.0, "ImagerPixelSpacing": list(PIXEL), "ViewPosition": "PA",
      "PatientOrientation": ["L", "F"]}
LINES = Intensity("line_integrals", scale=1e-3)


def counts(views=1, seed=0):
    return np.random.default_rng(seed).integers(1, 60000, (views, *SHAPE)).astype(np.uint16)


def angled(primary, secondary=0.0):
    return XA | {"PositionerPrimaryAngle": primary, "PositionerSecondaryAngle": secondary}


def one(folder, stored=None, modality="XA", **tags):
    """A folder with one single-frame file."""
    write_dicom(folder / "a.dcm", counts()[0] if stored is None else stored, modality, **tags)
    return folder


def beam_of(folder, modality="XA", **tags):
    return load_xrays(one(folder, None, modality, **tags), intensity=LINES)["beam"]


def described(folder, **blocks):
    (folder / "geometry.yaml").write_text(yaml.safe_dump(blocks))
    return folder


def fails(sentence, folder, **arguments):
    with pytest.raises(ValueError, match=sentence) as caught:
        load_xrays(folder, **arguments)
    assert "\n" not in str(caught.value)


def test_a_run_around_the_patient_is_our_orbit(tmp_path):
    write_dicom(tmp_path / "run.dcm", counts(8), **orbit_tags(8, 1020.0, 740.0, PIXEL))
    case = load_xrays(tmp_path, intensity=LINES)
    assert case["beam"].same_as(ConeBeam.orbit(8, 1020, 740, SHAPE, PIXEL), tolerance=1e-6)
    np.testing.assert_allclose(case["xrays"], 1e-3 * counts(8), rtol=1e-6)


def test_one_increment_is_the_step_of_every_frame(tmp_path):
    tags = orbit_tags(8, 1020.0, 740.0, PIXEL) | {"PositionerPrimaryAngleIncrement": -45.0}
    write_dicom(tmp_path / "run.dcm", counts(8), **tags)
    assert load_xrays(tmp_path, intensity=LINES)["beam"].same_as(ConeBeam.orbit(8, 1020, 740, SHAPE, PIXEL), 1e-6)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_increments_of_another_number_of_frames_are_not_guessed_at(tmp_path, frames):
    tags = orbit_tags(4, 1020.0, 740.0, PIXEL) | {"PositionerSecondaryAngleIncrement": 0.0}
    write_dicom(tmp_path / "part.dcm", counts(frames), **tags)
    fails("PositionerPrimaryAngleIncrement does not hold one value for each frame.*primary_degrees: ", tmp_path,
          intensity=LINES)
    angles = [30.0 * k for k in range(frames)]
    described(tmp_path, beam={"dicom": {"primary_degrees": angles}})
    expected = ConeBeam.at_angles([-angle for angle in angles], 1020, 740, SHAPE, PIXEL)
    assert load_xrays(tmp_path, intensity=LINES)["beam"].same_as(expected, 1e-6)


@pytest.mark.parametrize("primary, secondary, detector", [
    (0, 0, [0, 1, 0]), (90, 0, [-1, 0, 0]), (-90, 0, [1, 0, 0]), (180, 0, [0, -1, 0]),
    (0, 90, [0, 0, 1]), (0, -90, [0, 0, -1]), (30, 0, [-0.5, 0.75**0.5, 0]), (0, 30, [0, 0.75**0.5, 0.5]),
    (90, 30, [-(0.75**0.5), 0, 0.5])],
    ids=["chest", "LAO 90", "RAO 90", "back", "cranial", "caudal", "LAO 30", "cranial 30", "LAO 90 cranial 30"])
def test_the_detector_stands_where_the_positioner_angles_say(tmp_path, primary, secondary, detector):
    beam = beam_of(tmp_path, **angled(primary, secondary))
    np.testing.assert_allclose(beam.detectors[0], 280 * np.array(detector), atol=1e-9)
    np.testing.assert_allclose(beam.sources[0], -740 * np.array(detector), atol=1e-9)
    np.testing.assert_allclose(beam.distances, 1020)
    assert beam.u[0] @ beam.v[0] == pytest.approx(0, abs=1e-9)
    assert np.cross(beam.u[0], beam.v[0]) @ beam.sources[0] > 0  # seen from the detector
    assert beam.u[0, 2] == 0 and beam.v[0, 2] <= 1e-9  # head up


def test_files_of_single_frames_keep_their_own_angles_in_natural_order(tmp_path):
    for k, primary in enumerate(range(0, 330, 30)):
        image = np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE) + np.uint16(k)
        write_dicom(tmp_path / f"IM{k}", image, **angled(float(-primary)))  # no ending
    case = load_xrays(find_xrays(tmp_path)[0], intensity=LINES)
    assert case["xrays"][:, 0, 0].tolist() == pytest.approx([1e-3 * k for k in range(11)])
    assert case["beam"].same_as(ConeBeam.orbit(12, 1020, 740, SHAPE, PIXEL).select(slice(11)), 1e-6)


def test_enhanced_xa_holds_its_angles_per_frame_and_the_rest_shared(tmp_path):
    path = write_dicom(tmp_path / "run.dcm", counts(3))
    dataset = pydicom.dcmread(path)
    dataset.PerFrameFunctionalGroupsSequence = Sequence([
        group(PositionerPositionSequence={"PositionerPrimaryAngle": -120.0 * k, "PositionerSecondaryAngle": 0.0})
        for k in range(3)])
    dataset.SharedFunctionalGroupsSequence = Sequence([group(
        XRayGeometrySequence={"DistanceSourceToIsocenter": 740.0, "DistanceSourceToDetector": 1020.0},
        FramePixelDataPropertiesSequence={"ImagerPixelSpacing": list(PIXEL)},
        PixelValueTransformationSequence={"RescaleSlope": 0.5, "RescaleIntercept": 3.0})])
    dataset.save_as(path)
    case = load_xrays(tmp_path, intensity=LINES)
    assert case["beam"].same_as(ConeBeam.orbit(3, 1020, 740, SHAPE, PIXEL), 1e-6)
    np.testing.assert_allclose(case["xrays"], 1e-3 * (0.5 * counts(3) + 3.0), rtol=1e-6)


def group(**sequences):
    """One item of a functional groups sequence."""
    item = Dataset()
    for keyword, values in sequences.items():
        inner = Dataset()
        for name, value in values.items():
            setattr(inner, name, value)
        setattr(item, keyword, Sequence([inner]))
    return item


@pytest.mark.parametrize("where", ["tag", "geometry.yaml"])
@pytest.mark.parametrize("frames", [3, 5, 8])
def test_the_orientation_of_a_run_is_of_its_first_frame(tmp_path, frames, where):
    tags = orbit_tags(frames, 1020.0, 740.0, PIXEL) | ({"PatientOrientation": ["L", "F"]} if where == "tag" else {})
    write_dicom(tmp_path / "run.dcm", counts(frames), **tags)
    if where != "tag":
        described(tmp_path, beam={"dicom": {"patient_orientation": "L\\F"}})
    expected = ConeBeam.orbit(frames, 1020, 740, SHAPE, PIXEL)
    assert load_xrays(tmp_path, intensity=LINES)["beam"].same_as(expected, 1e-6)


@pytest.mark.parametrize("tags, words", [
    ({"FieldOfViewHorizontalFlip": "YES"}, "was flipped since"),
    ({"FieldOfViewRotation": 90.0}, "rotated by 90 degrees"),
    ({"FieldOfViewRotation": 180.0, "FieldOfViewHorizontalFlip": "YES"}, "rotated by 180 degrees and flipped")])
def test_an_image_that_was_turned_since_it_was_taken_needs_its_orientation(tmp_path, tags, words):
    fails(f"{words}.*patient_orientation", one(tmp_path, **angled(0.0), **tags), intensity=LINES)
    described(tmp_path, beam={"dicom": {"patient_orientation": "R\\F"}})
    assert load_xrays(tmp_path, intensity=LINES)["beam"].u[0].tolist() == pytest.approx([80, 0, 0])
    (tmp_path / "geometry.yaml").unlink()
    assert beam_of(tmp_path, **angled(0.0), PatientOrientation=["L", "F"], **tags).u[0, 0] < 0


def test_a_detector_tilted_against_the_beam_is_warned_of(tmp_path):
    with pytest.warns(UserWarning, match="DetectorPrimaryAngle 10 degrees, but the beam is taken as perpendicular"):
        beam_of(tmp_path, **angled(0.0), DetectorPrimaryAngle=10.0, DetectorSecondaryAngle=0.5)


def test_an_angle_that_contradicts_the_view_position_is_refused_unless_one_is_stated(tmp_path):
    tags = DX | {"ViewPosition": "AP", "PositionerPrimaryAngle": 0.0}
    fails("PositionerPrimaryAngle 0 contradicts ViewPosition, which means 180", one(tmp_path, None, "DX", **tags),
          intensity=LINES)
    described(tmp_path, beam={"dicom": {"primary_degrees": 180.0}})
    assert load_xrays(tmp_path, intensity=LINES)["beam"].sources[0, 1] == pytest.approx(1500)
    (tmp_path / "geometry.yaml").unlink()
    near = beam_of(tmp_path, "DX", **DX | {"PositionerPrimaryAngle": 30.0})  # its secondary angle is 0
    np.testing.assert_allclose(near.sources[0], [750, -1500 * 0.75**0.5, 0], atol=1e-9)


@pytest.mark.parametrize("position, orientation, source, u", [
    ("PA", ["L", "F"], [0, -1, 0], [-1, 0, 0]), ("AP", ["L", "F"], [0, 1, 0], [-1, 0, 0]),
    ("LL", ["A", "F"], [1, 0, 0], [0, 1, 0]), ("RL", ["A", "F"], [-1, 0, 0], [0, 1, 0]),
    ("PA", ["R", "F"], [0, -1, 0], [1, 0, 0])], ids=str)
def test_a_radiograph_is_placed_by_view_position_and_patient_orientation(tmp_path, position, orientation, source, u):
    beam = beam_of(tmp_path, "DX", **DX | {"ViewPosition": position, "PatientOrientation": orientation})
    np.testing.assert_allclose(beam.sources[0], 1500 * np.array(source), atol=1e-9)  # 1800 mm / 1.2
    np.testing.assert_allclose(beam.u[0], 80 * np.array(u), atol=1e-9)
    np.testing.assert_allclose(beam.v[0], [0, 0, -70], atol=1e-9)


def test_a_magnification_goes_with_a_stated_detector_distance(tmp_path):
    tags = {name: value for name, value in DX.items() if name != "DistanceSourceToDetector"}
    folder = one(tmp_path, None, "DX", **tags)
    fails(r"a.dcm lacks DistanceSourceToDetector \(0018,1110\), so", folder, intensity=LINES)
    described(folder, beam={"dicom": {"source_to_detector": 1200}})
    np.testing.assert_allclose(load_xrays(folder, intensity=LINES)["beam"].sources, [[0, -1000, 0]], atol=1e-9)


def test_a_turned_image_keeps_its_rows_and_columns(tmp_path):
    beam = beam_of(tmp_path, **angled(45) | {"PatientOrientation": ["F", "RA"]})
    np.testing.assert_allclose(beam.u[0], [0, 0, -80], atol=1e-9)
    np.testing.assert_allclose(beam.v[0], 70 * np.array([0.5**0.5, 0.5**0.5, 0]), atol=1e-9)


def test_geometry_yaml_overrides_tags_one_by_one_or_all(tmp_path):
    folder = described(one(tmp_path / "some", **angled(0.0)), beam={"dicom": {
        "source_to_isocentre": 700.0, "primary_degrees": [-90.0]}}, intensity={"kind": "line_integrals", "scale": 1e-3})
    np.testing.assert_allclose(load_xrays(folder)["beam"].sources, [[-700, 0, 0]], atol=1e-9)
    described(folder, beam={"dicom": {"pixel": [7, 8], "patient_orientation": "R\\F"}})
    np.testing.assert_allclose(load_xrays(folder, intensity=LINES)["beam"].u, [[8, 0, 0]], atol=1e-9)
    beam = ConeBeam.orbit(1, 900, 600, SHAPE, 50)
    folder = described(one(tmp_path / "all"), beam=beam.to_dict(), intensity={"kind": "line_integrals", "scale": 1e-3})
    assert load_xrays(folder)["beam"].same_as(beam)


@pytest.mark.parametrize("orientation", [{"rotate_degrees": 90}, {"flip_columns": True}])
def test_an_image_that_its_tag_turns_is_not_turned_again_without_a_word(tmp_path, orientation):
    given = angled(0.0) | {"PatientOrientation": ["F", "R"]}
    said = {"orientation": orientation, "intensity": {"kind": "line_integrals", "scale": 1e-4}}
    folder = described(one(tmp_path, **given), **said)
    with pytest.raises(ValueError, match=r"PatientOrientation of .* says already how its image is turned: leave"):
        load_xrays(folder)
    described(folder, beam={"dicom": {"patient_orientation": "L\\F"}}, **said)
    assert load_xrays(folder)["beam"].u[0, 0] < 0


def test_turned_images_turn_the_pixels_of_their_tags(tmp_path):
    folder = described(one(tmp_path, **angled(0.0)), orientation={"rotate_degrees": 90},
                       intensity={"kind": "line_integrals", "scale": 1e-3})
    case = load_xrays(folder)
    np.testing.assert_allclose(case["xrays"][0], 1e-3 * np.rot90(counts()[0], -1), rtol=1e-6)
    assert case["beam"].shape == (5, 6) and np.linalg.norm(case["beam"].u) == pytest.approx(70)


def test_rescaling_is_applied_and_the_window_is_not(tmp_path):
    case = load_xrays(one(tmp_path, **angled(0.0), RescaleSlope=0.25, RescaleIntercept=-2.0, WindowCenter=3.0,
                          WindowWidth=1.0), intensity=LINES)
    np.testing.assert_allclose(case["xrays"][0], 1e-3 * (0.25 * counts()[0] - 2), rtol=1e-5)


@pytest.mark.parametrize("tags, hidden", [
    ({"PixelPaddingValue": 65535}, [65535]),
    ({"PixelPaddingValue": 0, "PixelPaddingRangeLimit": 9}, [0, 4, 9]),
    ({"PixelPaddingValue": 65535, "PixelPaddingRangeLimit": 65000}, [65000, 65500])])
@pytest.mark.parametrize("rescale", [{}, {"RescaleSlope": -0.5, "RescaleIntercept": 40000.0}])
def test_padding_is_no_xray_whatever_the_rescale_makes_of_it(tmp_path, tags, hidden, rescale):
    stored = counts()[0] // 4 + 1000
    tags = angled(0.0) | rescale | tags
    plain = load_xrays(one(tmp_path / "a", stored, **tags), intensity=LINES)["xrays"]
    without = {name: value for name, value in tags.items() if "Padding" not in name}
    assert plain.equal(load_xrays(one(tmp_path / "b", stored, **without), intensity=LINES)["xrays"])
    stored[0, :len(hidden)] = hidden
    fails(f"{len(hidden)} pixels of .*a.dcm are padding .PixelPaddingValue {tags['PixelPaddingValue']}.: crop the",
          one(tmp_path / "c", stored, **tags), intensity=LINES)


def test_padding_is_named_by_its_frame(tmp_path):
    stored = counts(2)
    stored[1, 2] = 0
    write_dicom(tmp_path / "run.dcm", stored, **orbit_tags(2, 1020.0, 740.0, PIXEL), PixelPaddingValue=0)
    fails("5 pixels of .*run.dcm frame 2 are padding", tmp_path, intensity=LINES)


def test_monochrome1_turns_what_is_shown_and_leaves_quantities_alone(tmp_path):
    plain = one(tmp_path / "plain", **angled(0.0))
    inverted = one(tmp_path / "inverted", **angled(0.0), PhotometricInterpretation="MONOCHROME1")
    a, b = (load_xrays(folder, intensity=LINES)["xrays"] for folder in (plain, inverted))
    assert a.equal(b)
    bright, dark = (Intensity("display", bright_is_dense=value) for value in (True, False))
    assert load_xrays(inverted, intensity=bright)["xrays"].equal(load_xrays(plain, intensity=dark)["xrays"])
    assert load_xrays(inverted, intensity=bright)["display"]


@pytest.mark.parametrize("sign, photometric", [(-1, "MONOCHROME2"), (1, "MONOCHROME1"), (-1, "MONOCHROME1")])
def test_log_images_are_display_values_that_grow_with_density(tmp_path, sign, photometric):
    case = load_xrays(one(tmp_path, **angled(0.0), PixelIntensityRelationship="LOG",
                          PixelIntensityRelationshipSign=sign, PhotometricInterpretation=photometric))
    stored = torch.from_numpy(counts()[0].astype(np.float32))
    assert case["display"]
    assert np.corrcoef(case["xrays"].flatten(), stored.flatten())[0, 1] == pytest.approx(-sign)  # sign 1: bright is air


@pytest.mark.parametrize("sign", [1, -1])
def test_the_modality_lut_of_a_log_image_leads_back_to_intensity_and_is_passed_over(tmp_path, sign):
    stored, grey = counts()[0] % 4000, np.arange(4000)
    lut = Dataset()
    lut.LUTDescriptor, lut.ModalityLUTType = [4000, 0, 16], "US"
    lut.LUTData = np.rint(60000 * np.exp((grey - 3999 if sign == 1 else -grey) / 1000)).astype(int).tolist()
    lut["LUTDescriptor"].VR = lut["LUTData"].VR = "US"
    tags = angled(0.0) | {"PixelIntensityRelationship": "LOG", "PixelIntensityRelationshipSign": sign}
    plain, beside = one(tmp_path / "plain", stored, **tags), one(
        tmp_path / "beside", stored, **tags, ModalityLUTSequence=Sequence([lut]))
    assert load_xrays(beside)["xrays"].equal(load_xrays(plain)["xrays"])
    tags["PixelIntensityRelationship"] = "DISP"
    other = one(tmp_path / "other", stored, **tags, ModalityLUTSequence=Sequence([lut]))
    np.testing.assert_allclose(load_xrays(other, intensity=LINES)["xrays"][0], 1e-3 * np.array(lut.LUTData)[stored])


def test_linear_images_become_line_integrals_by_their_air(tmp_path):
    folder = one(tmp_path, **angled(0.0), PixelIntensityRelationship="LIN", PixelIntensityRelationshipSign=1)
    fails("PixelIntensityRelationship LIN.*air: ...", folder)
    described(folder, intensity={"kind": "counts", "air": 60000})
    np.testing.assert_allclose(load_xrays(folder)["xrays"], np.log(60000 / counts()), rtol=1e-5, atol=1e-6)


def test_linear_images_that_fall_with_intensity_are_counts_by_a_slope_of_the_other_sign(tmp_path):
    tags = angled(0.0) | {"PixelIntensityRelationship": "LIN", "PixelIntensityRelationshipSign": -1}
    of_air, falling = Intensity("counts", air=60000), 65535 - counts()
    plain = one(tmp_path / "plain", falling, **tags)
    for stated in (None, of_air):
        fails("LIN, sign -1.*its values fall.*RescaleSlope of the other sign.*display", plain, intensity=stated)
    turned = one(tmp_path / "turned", falling, **tags, RescaleSlope=-1, RescaleIntercept=65535)
    expected = np.log(60000 / counts())
    np.testing.assert_allclose(load_xrays(turned, intensity=of_air)["xrays"], expected, rtol=1e-5, atol=1e-6)


def test_values_of_unknown_meaning_are_refused(tmp_path):
    fails("PixelIntensityRelationship unknown.*`intensity:`", one(tmp_path / "a", **angled(0.0)))
    fails("declared as counts, but its PixelIntensityRelationship is LOG, sign -1", one(
        tmp_path / "b", **angled(0.0), PixelIntensityRelationship="LOG", PixelIntensityRelationshipSign=-1),
        intensity=Intensity("counts", air=60000))


@pytest.mark.parametrize("absent, sentence", [
    ("DistanceSourceToDetector", r"a.dcm lacks DistanceSourceToDetector \(0018,1110\).*source_to_detector: ..."),
    ("DistanceSourceToPatient", r"lacks DistanceSourceToPatient \(0018,1111\).*source_to_isocentre: ..."),
    ("ImagerPixelSpacing", r"lacks ImagerPixelSpacing \(0018,1164\).*pixel: ..."),
    ("PositionerPrimaryAngle", r"lacks PositionerPrimaryAngle \(0018,1510\).*primary_degrees: ..."),
])
def test_missing_tags_are_named_with_what_to_write_instead(tmp_path, absent, sentence):
    tags = angled(0.0)
    del tags[absent]
    fails(sentence, one(tmp_path, **tags), intensity=LINES)


def test_a_radiographs_distance_to_the_table_is_not_taken_for_the_isocentre(tmp_path):
    tags = {name: value for name, value in DX.items() if name != "EstimatedRadiographicMagnificationFactor"}
    folder = one(tmp_path, None, "DX", **tags)
    fails("lacks EstimatedRadiographicMagnificationFactor.*source_to_isocentre: ...", folder, intensity=LINES)
    described(folder, beam={"dicom": {"source_to_isocentre": 1600}})
    np.testing.assert_allclose(load_xrays(folder, intensity=LINES)["beam"].sources, [[0, -1600, 0]], atol=1e-9)


@pytest.mark.parametrize("tags, sentence", [
    ({"DistanceSourceToDetector": 0.0}, "source_to_detector is 0.0 .*must be positive"),
    ({"DistanceSourceToPatient": 1100.0}, "between source and detector, but source_to_isocentre=1100 mm"),
    ({"ImagerPixelSpacing": [0.0, 1.0]}, "pixel is .0.0, 1.0. .*must be positive"),
    ({"PatientOrientation": ["A", "F"]}, "does not give two directions across this view"),
    ({"PatientOrientation": ["L", "R"]}, "does not give two directions across this view"),
    ({"PatientOrientation": ["X", "F"]}, "must name directions by R, L"),
])
def test_impossible_tags_are_explained(tmp_path, tags, sentence):
    fails(sentence, one(tmp_path, **angled(0.0) | tags), intensity=LINES)


def test_wrong_overrides_are_explained(tmp_path):
    folder = one(tmp_path, **angled(0.0))
    fails("unknown key 'sod' in `dicom:`", described(folder, beam={"dicom": {"sod": 3}}), intensity=LINES)
    fails("`primary_degrees` in `dicom:` of .*geometry.yaml has 2 values for 1 views",
          described(folder, beam={"dicom": {"primary_degrees": [0, 1]}}), intensity=LINES)
    fails("`source_to_detector` in `dicom:` of .*geometry.yaml needs a number, but 'far'",
          described(folder, beam={"dicom": {"source_to_detector": "far"}}), intensity=LINES)
    fails(r"`pixel` in `dicom:` of .*geometry.yaml needs .row height, column width., but",
          described(folder, beam={"dicom": {"pixel": [1, 2, 3]}}), intensity=LINES)
    fails("unknown key 'orbit' in `beam:`", described(folder, beam={"dicom": {}, "orbit": {}}), intensity=LINES)


def test_files_that_are_no_grey_dicom_image_are_named(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "a.dcm").write_bytes(b"not DICOM")
    fails("a.dcm cannot be read", tmp_path / "a", intensity=LINES)
    path = one(tmp_path / "b", **angled(0.0)) / "a.dcm"
    path.write_bytes(path.read_bytes()[:-20])
    fails("a.dcm cannot be read", tmp_path / "b", intensity=LINES)
    fails("3 colours", one(tmp_path / "c", **angled(0.0), SamplesPerPixel=3), intensity=LINES)


def test_the_index_of_a_disc_is_no_view(tmp_path):
    one(tmp_path, **angled(0.0))
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM")
    assert len(load_xrays(tmp_path, intensity=LINES)["xrays"]) == 1


def test_dicom_and_other_images_are_not_mixed(tmp_path):
    folder = described(one(tmp_path, **angled(0.0)), beam=ConeBeam.orbit(2, 1020, 740, SHAPE, 70).to_dict())
    np.save(folder / "b.npy", counts()[0])
    fails(re.escape("DICOM files and others (b.npy)"), folder, intensity=LINES)


def test_a_deflated_file_is_refused_before_it_grows(tmp_path):
    file = one(tmp_path, **angled(0.0)) / "a.dcm"
    file.write_bytes(file.read_bytes().replace(b"\x14\x001.2.840.10008.1.2.1\0", b"\x16\x001.2.840.10008.1.2.1.99"))
    fails("a.dcm cannot be read .it is deflated as a whole, which is not read.; export it again, uncompressed",
    tmp_path,
          intensity=LINES)


def test_a_file_without_its_size_says_so(tmp_path):
    fails("a.dcm cannot be read .it lacks Rows.", one(tmp_path, Rows=None, **angled(0.0)), intensity=LINES)


def test_values_of_more_bits_than_their_tag_says_are_refused_and_not_cut(tmp_path):
    stored, tags = counts()[0] % 4096, angled(0.0) | {"BitsStored": 12, "HighBit": 11}
    plain = load_xrays(one(tmp_path / "plain", stored, **tags), intensity=LINES)["xrays"]
    np.testing.assert_allclose(plain[0], 1e-3 * stored, rtol=1e-6)
    sentence = "a.dcm cannot be read .5 of its values need more than its 12 BitsStored.*; export it again"
    for name, beyond in (("large", {}), ("padding", {"PixelPaddingValue": 63536})):
        wide = stored.copy()
        wide[0] = 63536
        fails(sentence, one(tmp_path / name, wide, **tags, **beyond), intensity=LINES)
    fails("more than its 12 BitsStored", one(tmp_path / "shifted", stored << 4, **tags | {"HighBit": 15}),
          intensity=LINES)
    drawn = one(tmp_path / "drawn", stored | np.uint16(1 << 15), **tags) / "a.dcm"
    dataset = pydicom.dcmread(drawn)
    dataset.add_new((0x6000, 0x0102), "US", 15)  # of an overlay
    dataset.save_as(drawn)
    assert load_xrays(drawn.parent, intensity=LINES)["xrays"].equal(plain)


def test_a_dicom_file_without_an_image_is_told_to_be_taken_out(tmp_path):
    path = write_dicom(one(tmp_path, **angled(0.0)) / "dose.dcm", counts()[0], Modality="SR")
    dataset = pydicom.dcmread(path)
    del dataset.PixelData
    dataset.save_as(path)
    fails("dose.dcm holds no image .PixelData., as .*: take it out of the folder$", tmp_path, intensity=LINES)


@pytest.mark.parametrize("other, warned", [("1", False), ("2", True), (None, False)])
def test_views_of_two_patients_are_warned_of_without_their_names(tmp_path, recwarn, other, warned):
    write_dicom(one(tmp_path, **angled(0.0), PatientID="1") / "b.dcm", counts()[0], **angled(90.0),
                **({"PatientID": other} if other else {}))
    assert len(load_xrays(tmp_path, intensity=LINES)["xrays"]) == 2
    assert [str(warning.message) for warning in recwarn] == [
        f"{tmp_path / 'a.dcm'} and {tmp_path / 'b.dcm'} have different PatientID, but the X-rays of a folder are taken "
        "as one patient's: keep those of each in a folder of their own"] * warned


@pytest.mark.parametrize("kind", ["Collimator", "Shutter"])
def test_what_a_collimator_covers_is_warned_of(tmp_path, recwarn, kind):
    shape, edges = {f"{kind}Shape": "RECTANGULAR"}, (
        f"{kind}LeftVerticalEdge", f"{kind}RightVerticalEdge", f"{kind}UpperHorizontalEdge",
        f"{kind}LowerHorizontalEdge")
    for name, beyond in (("whole", (1, 5, 1, 6)), ("wider", (-9, 99, 0, 7)), ("unfilled", (0, 0, 0, 0))):
        beam_of(tmp_path / name, **angled(0.0) | shape | dict(zip(edges, beyond)))
    assert not recwarn.list
    with pytest.warns(UserWarning, match=rf"a.dcm: 60% of its pixels lie beyond .*{kind}LeftVerticalEdge.*: crop"):
        beam_of(tmp_path / "covered", **angled(0.0) | shape | dict(zip(edges, (2, 4, 2, 5))))


def test_an_orientation_of_empty_words_is_none(tmp_path):
    empty = {"PatientOrientation": ["", ""]}
    beam = beam_of(tmp_path / "xa", **angled(30.0), **empty)
    assert beam.same_as(beam_of(tmp_path / "silent", **angled(30.0)))
    fails("lacks PatientOrientation", one(tmp_path / "dx", None, "DX", **DX | empty), intensity=LINES)
