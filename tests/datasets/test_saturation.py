"""Laws of saturated detectors: they are named by their counts, and what ends at one value for other reasons is not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import yaml

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


def read(folder, counts, air) -> tuple[np.ndarray, list[str]]:
    """The counts (2, V, U) as line integrals, and what is warned of where they are read."""
    folder.mkdir()
    for k, image in enumerate(counts):
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
