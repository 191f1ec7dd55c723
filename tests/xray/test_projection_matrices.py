"""Projection matrices: the beam of those that a beam's own pixels and rays give."""

import numpy as np
import pytest
import yaml

from phydict.datasets import load_xrays
from phydict.xray import ConeBeam
from phydict.xray.geometry_files import read_beam
from phydict.xray.projection_matrices import beam_of_matrices

BEAM = ConeBeam.from_dict({"orbit": {
    "views": 5, "source_to_detector": 1500, "source_to_isocentre": 1100, "shape": [12, 16], "pixel": [2.0, 1.5],
    "arc_degrees": 187.5, "detector_shift": [10, 25], "tilt_degrees": 8}})


def matrices(beam: ConeBeam) -> np.ndarray:
    """By definition: what lies on the ray to pixel (c, r) goes to a multiple of (c, r, 1)."""
    out = []
    for source, detector, u, v in zip(beam.sources, beam.detectors, beam.u, beam.v):
        first = detector - (beam.shape[1] - 1) / 2 * u - (beam.shape[0] - 1) / 2 * v - source
        left = np.linalg.inv(np.stack([u, v, first], axis=1))
        out.append(np.hstack([left, -left @ source[:, None]]))
    return np.stack(out)


@pytest.mark.parametrize("factor", [1.0, -7.0])
def test_a_beam_comes_back_from_its_projection_matrices_whatever_their_factor(factor):
    found = beam_of_matrices(factor * matrices(BEAM), BEAM.shape, (2.0, 1.5))
    for name in ("sources", "detectors", "u", "v"):
        np.testing.assert_allclose(getattr(found, name), getattr(BEAM, name), atol=1e-9)


def test_a_file_of_matrices_beside_the_images_is_their_geometry(tmp_path):
    for k in range(5):
        np.save(tmp_path / f"view_{k}.npy", np.zeros(BEAM.shape, np.float32) + np.arange(BEAM.shape[1]))
    np.save(tmp_path / "matrices.npy", matrices(BEAM))
    content = {"file": "matrices.npy", "pixel": [2.0, 1.5]}
    (tmp_path / "geometry.yaml").write_text(yaml.safe_dump({"beam": content}))
    np.testing.assert_allclose(load_xrays(tmp_path)["beam"].sources, BEAM.sources, atol=1e-9)
    (tmp_path / "geometry.yaml").write_text(yaml.safe_dump({"beam": {"file": "matrices.npy"}}))
    with pytest.raises(ValueError, match="matrices.npy does not say how large the pixels are; state `pixel`"):
        load_xrays(tmp_path)


@pytest.mark.parametrize("scaled", [lambda p: p, lambda p: p / p[:, 2:, 3:]])
@pytest.mark.parametrize("beam", [BEAM, ConeBeam.orbit(8, 1020, 740, (448, 448), 1.25)], ids=["few pixels", "many"])
def test_matrices_in_rows_of_twelve_are_told_how_to_be_saved(tmp_path, beam, scaled):
    rows = scaled(matrices(beam)).reshape(beam.views, 12)
    np.save(tmp_path / "rows.npy", rows)
    np.savetxt(tmp_path / "rows.csv", rows, fmt="%.7g", delimiter=",")
    for name in ("rows.npy", "rows.csv"):
        for pixel in (None, 1.25):
            with pytest.raises(ValueError, match=rf"{name} holds projection matrices .* shape \({beam.views}, 12\), but"
                                                 r" .*detector centre, u and v: save .*reshape\(-1, 3, 4\)"):
                read_beam(tmp_path / name, beam.shape, pixel)


@pytest.mark.parametrize("spoil, sentence", [
    (lambda p: p[:, [0, 0, 2]], "has no source"), (lambda p: p * 0, "has no source"),
    (lambda p: p[:, [1, 0, 2]], "pixels of 1.5 mm width are 1.125 mm high"),
    (lambda p: p * [[[1], [1.3], [1]]], "mm high, but a pixel of")])
def test_matrices_that_say_something_else_are_refused_by_view(spoil, sentence):
    with pytest.raises(ValueError, match=f"view 0: .*{sentence}"):
        beam_of_matrices(spoil(matrices(BEAM)), BEAM.shape, (2.0, 1.5))
