"""Damaged files of users: one sentence that names the file, before they take time or memory."""

import io
import struct
import warnings

import numpy as np
import pydicom
import pytest
import torch
from dicom_files import orbit_tags, write_ct_series, write_dicom
from PIL import Image

from phydict import Grid, reconstruct
from phydict.datasets import read_calibrations
from phydict.datasets.cts.ct_series import find_series, load_series
from phydict.datasets.dicom import read_dicom
from phydict.datasets.radiographs.xray_images import read_image
from phydict.prior.finite import not_finite
from phydict.reconstruction import save_nifti
from phydict.runtime.reading import MAX_MESSAGE, Unreadable, reading, refusing
from phydict.runtime.seeds import check_seed


@pytest.mark.parametrize("tag, kind, value, sentence", [
    ("NumberOfFrames", "LO", "many", "slice003.dcm: NumberOfFrames must be a number, but 'many' was found"),
    ("ImageType", "FD", 1.5, None),
    ("PixelSpacing", "LO", ["wide", "wide"], "slice003.dcm: PixelSpacing must be 2 finite numbers"),
    ("Rows", "LO", "", "slice003.dcm lacks Rows")])
def test_tags_of_a_ct_slice_that_are_of_another_kind_are_named(tmp_path, tag, kind, value, sentence):
    paths = write_ct_series(tmp_path, np.zeros((9, 9, 9)), np.diag([5.0, 5, 5, 1]))
    dataset = pydicom.dcmread(paths[3])
    dataset.pop(tag, None)
    dataset.add(pydicom.DataElement(tag, kind, value))
    dataset.save_as(paths[3])
    series, = find_series(tmp_path)
    if sentence is None:
        assert load_series(series)[0].shape == (9, 9, 9)
        return
    with pytest.raises(ValueError, match=sentence):
        load_series(series)


@pytest.mark.parametrize("element, name, read", [
    (("PatientOrientation", "FD", 2.0), "patient_orientation", ("2.0",)),
    (("PixelIntensityRelationship", "LT", "LOG\r\n" + "x" * 999), "relationship", "LOG " + "x" * 12)])
def test_a_number_in_place_of_a_word_is_read_as_one_and_words_are_cut_to_one_line_of_sixteen(
        tmp_path, element, name, read):
    path = write_dicom(tmp_path / "a.dcm", np.zeros((4, 5), np.uint16), **orbit_tags(1, 1020.0, 740.0, (1.0, 1.0)))
    dataset = pydicom.dcmread(path)
    dataset.add(pydicom.DataElement(*element))
    dataset.save_as(path)
    (_, tags), = read_dicom(path)
    assert getattr(tags, name) == read


def test_a_name_with_line_breaks_does_not_break_the_sentence(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text('VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n"a\n' + "b" * 99 + '",x,0,1,1\n')
    with pytest.raises(ValueError, match="^the metadata of a bbb") as caught:
        read_calibrations(table)
    assert "\n" not in str(caught.value)
    with pytest.raises(Unreadable) as caught, refusing(table, "save it again"):
        raise ValueError("[" * 10_000)
    assert len(str(caught.value)) < MAX_MESSAGE + 10


def _tiff(width: int, height: int) -> bytes:
    """A TIFF of one bit per pixel that holds one of its rows."""
    values = {256: width, 257: height, 258: 1, 259: 1, 262: 1, 273: 110, 278: height, 279: 1}
    tags = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in values.items())
    return struct.pack("<2sHIH", b"II", 42, 8, len(values)) + tags + bytes(16)


@pytest.mark.parametrize("shape, words", [
    ((5, 4_000_000), "promises 20,000,000 pixels"), ((10_000, 10_000), "exceeds limit")])
def test_a_picture_of_more_pixels_than_its_file_can_hold_is_not_read(tmp_path, monkeypatch, shape, words):
    path = tmp_path / "v.tif"
    path.write_bytes(_tiff(*shape))
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("it was read"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=words):
            read_image(path)


def test_dicom_that_promises_what_its_file_cannot_hold_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    path = write_dicom(tmp_path / "a.dcm", np.zeros((4, 5), np.uint16), Rows=60000, Columns=60000)
    monkeypatch.setattr(pydicom.Dataset, "pixel_array", property(lambda self: pytest.fail("it was decoded")))
    with pytest.raises(ValueError, match=r"a.dcm cannot be read .its header promises 3,600,000,000 pixels"):
        read_dicom(path)


def test_an_array_whose_header_confuses_numpy_is_refused_in_words_for_users(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.zeros((6, 5), np.float32))
    path = tmp_path / "v.npy"
    path.write_bytes(stream.getvalue().replace(b" 'shape'", b"b'shape'"))
    with pytest.raises(Unreadable, match=r"v.npy cannot be read .it holds something of another kind than expected"):
        read_image(path)


def test_words_where_dicom_needs_a_number_are_named(tmp_path):
    path = write_dicom(tmp_path / "a.dcm", np.zeros((4, 5), np.uint16))
    dataset = pydicom.dcmread(path)
    dataset.add(pydicom.DataElement("NumberOfFrames", "LO", "many"))
    dataset.save_as(path)
    with pytest.raises(ValueError, match="'many' stands where a number is needed"):
        read_dicom(path)


def test_weights_of_four_bits_are_no_plain_numbers():
    four = torch.zeros(1, dtype=torch.uint8).view(torch.float4_e2m1fn_x2)
    assert not_finite({"a": four}) == "a holds no plain numbers"


@pytest.mark.parametrize("name", ["", "volume.txt"])
def test_a_volume_is_written_as_nifti_alone(tmp_path, name):
    with pytest.raises(ValueError, match=r"end the name in .nii or .nii.gz"):
        save_nifti(tmp_path / name, np.zeros((2, 2, 2)), Grid.cube(2))


def test_x_rays_in_the_place_of_the_beam_are_named_in_one_short_line():
    with pytest.raises(ValueError, match="must be a ConeBeam") as caught:
        reconstruct(torch.zeros(2, 40, 40), torch.zeros(2, 40, 40))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("seed", [True, -1, 1.5, 2**32], ids=str)  # of more bits torch's generator drops the upper ones
def test_what_is_no_seed_of_its_own_is_refused(seed):
    with pytest.raises(ValueError, match="a seed is a whole number from 0"):
        check_seed(seed)


def test_what_refuses_keeps_its_own_sentence_and_every_other_error_becomes_one():
    with pytest.raises(ValueError, match="^x.yaml: it is empty$"), refusing("x.yaml", "fill it"):
        raise ValueError("it is\nempty")
    with pytest.raises(FileNotFoundError, match="^x.yaml is gone$"), refusing("x.yaml", "fill it"):
        raise FileNotFoundError("x.yaml is gone")
    for error in (KeyError("a"), OverflowError("too large"), UnicodeDecodeError("utf-8", b"x", 0, 1, "bad")):
        with pytest.raises(Unreadable, match=r"^x.yaml cannot be read \(.*\); fill it$"), refusing("x.yaml", "fill it"):
            raise error
    with pytest.raises(Unreadable, match="it has no setting 'b'"), reading("x", "y"):
        (lambda: None)(b=1)
