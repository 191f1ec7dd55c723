"""Other programs' geometries by the functions and sentences of data/README.md: points land where each program's own
formulas put them, at an oblique angle, off the detector's middle, on pixels that are no squares."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from phydict.xray import ConeBeam
from phydict.xray.projection_matrices import beam_of_matrices

PAGE = (Path(__file__).parents[2] / "data" / "README.md").read_text()
[BLOCK] = re.findall(r"```python\n(.*?)```", PAGE.partition("## Other geometries")[2].partition("\n## ")[0], re.DOTALL)
DOCUMENTED: dict = {}
exec(BLOCK, DOCUMENTED)
POINTS = np.array([[31.0, -42.0, 17.0], [-55.0, 13.0, -64.0], [8.0, 77.0, 29.0]])
SHAPE, MIDDLE = (48, 63), (23.5, 31.0)
HEIGHT, WIDTH, TO_DETECTOR, TO_ORIGIN = 2.0, 1.5, 1020.0, 700.0


def about(axis: int, angle: float) -> np.ndarray:
    """The rotation about an axis of the world."""
    turn, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
    turn[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return turn


TURN = about(2, 0.7) @ about(0, 0.2) @ about(1, -0.1)


def seen(beam: ConeBeam) -> np.ndarray:
    """Column and row (N, 2) at which the beam's only view sees the points."""
    return beam.shadows(POINTS)[0] / beam.pixel[0, ::-1] + MIDDLE[::-1]


def landing(source, pixel) -> np.ndarray:
    """Column and row (N, 2) at which rays through the points meet the plane of a program's pixels, which `pixel` places
    by column and row."""
    first = pixel(0, 0)
    sides = pixel(1, 0) - first, pixel(0, 1) - first
    return np.array([np.linalg.solve(np.stack([*sides, source - point], 1), source - first)[:2] for point in POINTS])


def test_tigres_pixels_are_where_its_kernels_place_them():
    """As its projection kernels compute: eulerZYZ, rollPitchYaw, offsets, COR; image row 0 is the lowest."""
    (alpha, theta, psi), (x, y, z), (up, along), shift = (0.7, 0.11, -0.23), (0.05, -0.03, 0.08), (7.0, -23.0), 4.0

    def place(point):
        moved = about(2, alpha) @ about(1, theta) @ about(2, psi) @ point
        return moved + [-shift * np.sin(alpha), shift * np.cos(alpha), 0]

    def pixel(column, row):
        panel = about(2, z) @ about(1, y) @ about(0, x) @ [0, WIDTH * (column - 31), HEIGHT * (row - 23.5)]
        return place(panel + [TO_ORIGIN - TO_DETECTOR, along, up])

    geo = SimpleNamespace(
        angles=np.array([[alpha, theta, psi]]), rotDetector=np.array([[x, y, z]]), offDetector=np.array([[up, along]]),
        COR=np.array([shift]), DSO=np.array([TO_ORIGIN]), DSD=np.array([TO_DETECTOR]), nDetector=np.array(SHAPE),
        dDetector=np.array([HEIGHT, WIDTH]))
    np.testing.assert_allclose(seen(DOCUMENTED["tigre"](geo)), landing(place([TO_ORIGIN, 0, 0]), pixel), atol=1e-6)


@pytest.mark.parametrize("program", ["leap", "odl"])
def test_vectors_of_leap_and_odl_lead_from_pixel_to_pixel_as_theirs(program):
    """LEAP's set_modularbeam: the module's centre and unit vectors from row to row and column to column. ODL's
    detector: parameters (a, b) lie at its reference point + a axis 0 + b axis 1, and columns along a."""
    source, centre, axes = TURN @ [9, -TO_ORIGIN, -5], TURN @ [-30, 320, 40], TURN[:, [0, 2]].T
    middle, sides = np.array([-20.0, 9.0]), np.array([WIDTH, HEIGHT])
    geometry = SimpleNamespace(
        get_sourcePositions=lambda: source[None], get_moduleCenters=lambda: centre[None], get_pixelWidth=lambda: WIDTH,
        get_pixelHeight=lambda: HEIGHT, get_colVectors=lambda: axes[:1], get_rowVectors=lambda: axes[1:],
        get_numRows=lambda: SHAPE[0], get_numCols=lambda: SHAPE[1],
        angles=np.zeros(1), src_position=lambda angles: source[None], det_axes=lambda angles: axes[None],
        det_point_position=lambda angles, at: (centre + (at - middle) @ axes)[None],
        det_params=SimpleNamespace(mid_pt=middle), det_partition=SimpleNamespace(cell_sides=sides, shape=SHAPE[::-1]))
    expected = landing(source, lambda column, row: centre + (sides * (column - 31, row - 23.5)) @ axes)
    np.testing.assert_allclose(seen(DOCUMENTED[program](geometry)), expected, atol=1e-6)


@pytest.mark.parametrize("signs, offset, pixel", [
    ((-1, -1), 1, lambda x, y: (-x, -y)), ((1, -1), 1, lambda x, y: (x, -y)),  # DiffDRR, its reverse_x_axis or not
    ((1, 1), -1, lambda x, y: (x, y))], ids=["DiffDRR", "DiffDRR, not reversed", "nanodrr"])
def test_a_camera_of_diffdrr_or_nanodrr_sees_points_on_the_pixels_it_places(signs, offset, pixel):
    """A pixel in the frame of the camera, which looks along z, as DiffDRR's detector or nanodrr's renderer place it."""
    P, (x0, y0) = np.eye(4), (13.0, -21.0)
    P[:3, :3], P[:3, 3] = TURN @ about(0, np.pi / 2), TURN @ [5, TO_ORIGIN, -7]

    def place(column, row):
        x, y = pixel(column - 31, row - 23.5)
        return (P @ [WIDTH * x + offset * x0, HEIGHT * y + offset * y0, TO_DETECTOR, 1])[:3]

    sides, offsets = np.multiply(signs, (WIDTH, HEIGHT)), (offset * x0, offset * y0)
    beam = DOCUMENTED["camera"](P[None], TO_DETECTOR, *sides, *offsets, SHAPE)
    np.testing.assert_allclose(seen(beam), landing(P[:3, 3], place), atol=1e-6)


@pytest.mark.parametrize("told, first", [
    (lambda P: P, (0, 0)), (lambda P: [[1, 0, -1], [0, 1, -1], [0, 0, 1]] @ P, (1, 1)),
    (lambda P: [[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]] @ P, (0.5, 0.5))], ids=["0", "1", "corner"])
@pytest.mark.parametrize("axes", [(1, 1, 1, 1), (-1, -1, 1, 1)], ids=["RAS+", "LPS+"])
def test_matrices_of_other_axes_and_first_pixels_are_read_once_multiplied_as_told(told, first, axes):
    """K [R | t] whose first pixel's centre is at `first`, of RAS+ or LPS+ mm."""
    K = [[TO_DETECTOR / WIDTH, 0, 40 + first[0]], [0, TO_DETECTOR / HEIGHT, 20 + first[1]], [0, 0, 1]]
    P = K @ np.column_stack([TURN, [5, -7, TO_ORIGIN]]) @ np.diag(axes)
    lands = np.c_[POINTS * axes[:3], np.ones(3)] @ P.T
    beam = beam_of_matrices((told(P) @ np.diag(axes))[None], SHAPE, (HEIGHT, WIDTH))
    np.testing.assert_allclose(seen(beam), lands[:, :2] / lands[:, 2:] - first, atol=1e-6)
