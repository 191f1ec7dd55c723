"""Laws that hold for every grid, beam, table and schedule that can be drawn."""

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from phydict.diffusion import CosineSchedule
from phydict.evaluation import read_csv, write_csv
from phydict.grid import Grid
from phydict.prior.tiles import Tiles
from phydict.xray import ConeBeam

settings.register_profile("laws", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("laws")

LENGTHS = st.floats(0.1, 1000.0)
ANGLES = st.floats(-math.pi, math.pi)


def turned(angles: tuple[float, float, float]) -> np.ndarray:
    """A rotation matrix."""
    result = np.eye(3)
    for (i, j), angle in zip(((0, 1), (1, 2), (0, 2)), angles):
        turn = np.eye(3)
        turn[[i, j], [i, j]], turn[i, j], turn[j, i] = np.cos(angle), -np.sin(angle), np.sin(angle)
        result = turn @ result
    return result


@st.composite
def grids(draw) -> Grid:
    """Grids of any shape, spacing, place and orientation."""
    affine = np.eye(4)
    affine[:3, :3] = turned(draw(st.tuples(ANGLES, ANGLES, ANGLES))) * draw(st.tuples(LENGTHS, LENGTHS, LENGTHS))
    affine[:3, 3] = draw(st.tuples(*[st.floats(-1e4, 1e4)] * 3))
    return Grid(draw(st.tuples(*[st.integers(1, 40)] * 3)), affine=affine)


@st.composite
def beams(draw, multiple: int = 1) -> ConeBeam:
    """Orbits of a few views, with detectors of a multiple of some pixels."""
    to_detector = draw(st.floats(500.0, 3000.0))
    to_isocentre = draw(st.floats(0.2, 0.9)) * to_detector
    return ConeBeam.orbit(draw(st.integers(1, 7)), to_detector, to_isocentre,
                          draw(st.tuples(*[st.integers(1, 20).map(lambda n: multiple * n)] * 2)),
                          draw(st.floats(0.1, 20.0)),
                          start=draw(ANGLES))


@given(grids(), st.tuples(*[st.floats(-1e4, 1e4)] * 3))
def test_a_grids_index_undoes_its_affine(grid, world):
    index = grid.index(np.array(world))
    back = grid.affine[:3, :3] @ index + grid.affine[:3, 3]
    np.testing.assert_allclose(back, world, atol=1e-6 * max(1.0, float(abs(index).max())))


@given(grids())
def test_a_grid_is_the_one_that_its_dictionary_builds(grid):
    again = Grid(**grid.to_dict())
    assert again.same_as(grid) and again.spacing == pytest.approx(grid.spacing)


@given(beams(), st.lists(st.integers(0, 6), min_size=1, max_size=9))
def test_selected_views_are_those_of_the_beam_in_that_order(beam, views):
    views = [view % beam.views for view in views]
    chosen = beam.select(views)
    for name in ("sources", "detectors", "u", "v"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(beam, name)[views])


@given(beams())
def test_a_geometry_file_gives_the_beam_back(beam):
    with tempfile.TemporaryDirectory() as folder:
        beam.save(Path(folder) / "geometry.yaml")
        assert ConeBeam.load(Path(folder) / "geometry.yaml").same_as(beam)


@given(st.integers(2, 4), st.data())
def test_a_binned_detector_covers_the_same_area(factor, data):
    beam = data.draw(beams(factor))
    coarse = beam.binned(factor)
    assert tuple(factor * n for n in coarse.shape) == beam.shape
    np.testing.assert_allclose(coarse.u, factor * beam.u)
    np.testing.assert_allclose(coarse.detectors, beam.detectors)


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"], exclude_characters="\r\x00"), min_size=1)
VALUES = st.one_of(st.integers(-2**60, 2**60), st.floats(allow_nan=False), NAMES)


@given(st.lists(st.dictionaries(st.sampled_from(["case", "method", "psnr", "a b", "x,y", 'q"']), VALUES, min_size=1),
                min_size=1, max_size=5))
def test_a_table_of_results_survives_its_file(rows):
    texts = ("case", "method")
    rows = [{k: str(v) if k in texts else v for k, v in row.items()} for row in rows]
    for row in rows:  # text that is a number in full comes back as that number
        for name, value in row.items():
            if name not in texts and isinstance(value, str):
                assume(not any(repr(kind) == value for kind in _numbers(value)))
    with tempfile.TemporaryDirectory() as folder:
        write_csv(Path(folder) / "results.csv", rows)
        assert read_csv(Path(folder) / "results.csv") == rows


def _numbers(text: str) -> list[int | float]:
    found = []
    for kind in (int, float):
        try:
            found.append(kind(text))
        except ValueError:
            continue
    return found


@given(st.integers(1, 8), st.integers(1, 12), st.integers(0, 8), st.integers(1, 200))
def test_the_weights_of_tiles_sum_to_one_everywhere(divisor, overlap, more, voxels):
    tiles = Tiles(divisor * (2 * overlap + more), divisor * overlap, divisor)
    total = torch.zeros(divisor * voxels, dtype=torch.float64)
    for place, weight in tiles.weights(divisor * voxels):
        assert (weight >= 0).all()
        total[place] += weight
    torch.testing.assert_close(total, torch.ones_like(total))


@given(st.floats(0.0, 0.1), st.floats(1e-6, 0.1), st.floats(0.0, 1.0))
def test_the_time_of_a_noise_level_has_that_level(offset, floor, t):
    schedule = CosineSchedule(offset, floor)
    sigma = float(schedule.sigma(t))
    assert float(schedule.sigma(schedule.time(sigma))) == pytest.approx(sigma, rel=1e-6)
