"""Laws of saturated detectors: they are named by their counts, and what ends at one value for other reasons is not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import yaml
from dicom_files import write_dicom

from phydict.datasets import load_xrays

SIDE, AIR = 256, 10_000
ORBIT = {"views": 2, "source_to_detector": 1020.0, "source_to_isocentre": 740.0, "shape": [SIDE, SIDE],
         "pixel": [2.0, 2.0]}


def line_integrals() -> np.ndarray:
    """Two views (2, V, U) of bodies with ribs and lungs in air."""
    y, x = (np.mgrid[:SIDE, :SIDE] / SIDE - 0.5) * 2
    views = []
    for half_width in (0.7, 0.5):
        depth = np.clip(1 - (x / half_width) ** 2 - (y / 0.9) ** 2, 0, None)
        ribs = 0.3 * np.clip(np.sin(20 * y + 3 * x), 0, None) ** 2
        lungs = 2.0 * np.exp(-((abs(x) - 0.25) ** 2 / 0.02 + y**2 / 0.1))
        views.append(np.clip(depth * (4.5 + ribs - lungs), 0, None))
    return np.stack(views)


def read(folder, counts, air, dicom=False) -> tuple[np.ndarray, list[str]]:
    """The counts (2, V, U) as line integrals, and what is warned of where they are read, from NPY or DICOM."""
    folder.mkdir()
    for k, image in enumerate(counts):
        if dicom:
            write_dicom(folder / f"view_{k}.dcm", image, "DX", PixelIntensityRelationship="LIN")
        else:
            np.save(folder / f"view_{k}.npy", image)
    (folder / "geometry.yaml").write_text(yaml.safe_dump({"orbit": ORBIT, "intensity": {"kind": "counts", "air": air}}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        xrays = load_xrays(folder)["xrays"].numpy()
    return xrays, [str(warning.message) for warning in caught]


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("exposure", [1.1, 1.3, 2.0])
def test_a_detector_that_saturates_in_air_is_named(tmp_path, bits, exposure):
    most, noisy = 2**bits - 1, np.random.default_rng(0).poisson(AIR * np.exp(-line_integrals())) / AIR
    stored = np.minimum(np.rint(exposure * most * noisy), most).astype(np.uint16)
    _, [text] = read(tmp_path / "case", stored, most)
    assert "2 of 2 views" in text and "saturates" in text and f"{(stored == most).mean((1, 2)).max():.0%}" in text


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_images_without_noise_end_in_air_and_are_no_saturated_ones(tmp_path, bits):
    most = 2**bits - 1
    assert not read(tmp_path / "case", np.rint(most * np.exp(-line_integrals())).astype(np.uint16), most)[1]


@pytest.mark.parametrize("clipped", [True, False])
def test_noise_around_air_is_no_saturation_even_if_clipped_there(tmp_path, clipped):
    stored = np.random.default_rng(1).poisson(AIR * np.exp(-line_integrals())).astype(np.uint16)
    assert not read(tmp_path / "case", stored.clip(max=AIR) if clipped else stored, AIR)[1]


def test_saturated_pixels_are_air_and_others_right_where_air_is_what_it_would_count_without_an_end(tmp_path):
    y, most, exposure = line_integrals(), 2**16 - 1, 1.5
    counts = np.rint(exposure * most * np.random.default_rng(2).poisson(AIR * np.exp(-y)) / AIR)
    xrays, _ = read(tmp_path / "case", counts.clip(max=most).astype(np.uint16), exposure * most)
    ends = counts >= most
    assert not xrays[ends].any() and abs(np.median((xrays - y)[~ends])) < 2e-3


def test_whole_counts_are_told_to_saturate_in_whatever_type_they_are_stored(tmp_path):
    noisy = np.random.default_rng(3).poisson(AIR * np.exp(-line_integrals()))
    stored = noisy.clip(max=8000).astype(np.uint16)
    expected, said = read(tmp_path / "integers", stored, AIR)
    for name, images, dicom in (("dicom", stored, True), ("floats", stored.astype(np.float32), False)):
        xrays, texts = read(tmp_path / name, images, AIR, dicom)
        assert texts == said and (xrays == expected).all()
    assert len(said) == 1 and not read(tmp_path / "scaled", 0.3 * stored, 0.3 * AIR)[1]
