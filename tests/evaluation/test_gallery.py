"""The pages show the patient the right way round, in true proportions, and survive values that are not finite."""

from __future__ import annotations

import resource

import matplotlib.image
import numpy as np
import pytest
import torch
from scipy.ndimage import find_objects, label

from phydict.evaluation.gallery import method_panel, panel, plane
from phydict.grid import Grid

GRID = Grid.cube(32)
HIGH, MIDDLE = slice(21, 29), slice(12, 20)


def air_with_block(x, y, z):
    volume = np.full(GRID.shape, -1000.0)
    volume[x, y, z] = 1000
    return volume


def panels_of(path):
    """The dark rectangles of a page from the left to the right, as boolean images of what is bright in them."""
    page = matplotlib.image.imread(path)[..., :3]
    dark = page.max(2) < 0.05
    found = [box for n, box in enumerate(find_objects(label(dark)[0]), 1)
             if box[0].stop - box[0].start > 150 and box[1].stop - box[1].start > 150]
    return [page[box].min(2) > 0.95 for box in sorted(found, key=lambda box: box[1].start)]


def centre_of(bright):
    """Centre of the bright pixels, as a fraction (down, right) of the panel."""
    return np.argwhere(bright).mean(0) / bright.shape


@pytest.mark.parametrize("place, block", [
    (0, (HIGH, HIGH, MIDDLE)),    # axial: right and anterior
    (1, (HIGH, MIDDLE, HIGH)),    # coronal: right and superior
    (2, (MIDDLE, HIGH, HIGH)),    # sagittal: anterior and superior
], ids=["axial", "coronal", "sagittal"])
def test_right_or_anterior_is_left_and_anterior_or_superior_is_up(tmp_path, place, block):
    panel(tmp_path / "p.png", air_with_block(*block), GRID)
    panels = panels_of(tmp_path / "p.png")
    assert len(panels) == 3
    down, right = centre_of(panels[place])
    wanted = 1 - 25 / 32
    assert down == pytest.approx(wanted, abs=0.02) and right == pytest.approx(wanted, abs=0.02)


def test_a_grid_with_other_axes_gives_the_same_planes():
    volume = np.random.default_rng(0).uniform(-1000, 400, (12, 10, 8))
    straight = Grid((12, 10, 8), (2, 3, 4))
    turned = np.ascontiguousarray(volume[::-1].transpose(2, 0, 1))
    affine = np.zeros((4, 4))
    affine[2, 0], affine[0, 1], affine[1, 2], affine[3, 3] = 4, -2, 3, 1
    affine[:3, 3] = straight.affine[:3, 3]
    affine[0, 3] *= -1
    other = Grid((8, 12, 10), affine=affine)
    for name in ("axial", "coronal", "sagittal"):
        (image, aspect), (same, same_aspect) = plane(volume, straight, name), plane(turned, other, name)
        assert aspect == same_aspect
        np.testing.assert_array_equal(image, same)


def test_proportions_follow_the_spacing(tmp_path):
    grid = Grid((32, 32, 32), (4, 4, 8))
    panel(tmp_path / "p.png", np.full(grid.shape, -1000.0), grid)
    ratios = [bright.shape[0] / bright.shape[1] for bright in panels_of(tmp_path / "p.png")]
    assert ratios == pytest.approx([1, 2, 2], abs=0.03)


def test_pages_are_written_with_every_combination_and_accept_tensors(tmp_path):
    volume = torch.randn(1, 1, 32, 32, 32) * 300
    xrays = torch.rand(1, 12, 10, 14)
    sizes = []
    for n, given in enumerate([{}, {"xrays": xrays}, {"xrays": xrays, "reprojection": xrays * 1.1},
                               {"xrays": xrays[:, :1], "reprojection": xrays[:, :1], "truth_hu": volume}]):
        panel(tmp_path / "deep" / f"{n}.png", volume, GRID, title="a case", **given)
        sizes.append(matplotlib.image.imread(tmp_path / "deep" / f"{n}.png").shape[0])
    assert sizes == sorted(set(sizes))


@pytest.mark.parametrize("given", [{}, {"truth_hu": np.full(GRID.shape, -1000.0)}], ids=["alone", "with the truth"])
def test_the_deviation_is_bright_where_it_is_large(tmp_path, given):
    deviation = np.zeros(GRID.shape)
    deviation[HIGH, HIGH, MIDDLE] = 600
    panel(tmp_path / "p.png", np.full(GRID.shape, -1000.0), GRID, deviation_hu=deviation, **given)
    page = matplotlib.image.imread(tmp_path / "p.png")[..., :3]
    brightest = np.argwhere(np.abs(page - [0.988, 1.0, 0.645]).max(2) < 0.02)  # inferno's end
    assert len(brightest) > 500
    (top, left), (bottom, right) = brightest.min(0), brightest.max(0)
    assert bottom - top == pytest.approx(right - left, abs=2) and left > page.shape[1] * 0.4  # in the last column


def test_values_that_are_not_finite_are_shown_in_magenta(tmp_path):
    volume = np.zeros(GRID.shape)
    volume[10:20, 10:20, 10:20] = np.nan
    xrays = np.ones((2, 8, 8))
    panel(tmp_path / "p.png", volume, GRID, xrays, np.full_like(xrays, np.inf), np.full(GRID.shape, np.nan))
    page = matplotlib.image.imread(tmp_path / "p.png")
    assert (np.abs(page[..., :3] - [1, 0, 1]).max(2) < 0.01).sum() > 1000


@pytest.mark.parametrize("shape, pixel, ratio", [((8, 8), 2.0, 2.0), ((8, 8), 0.5, 0.5), ((1, 600), 1.0, 1 / 15),
                                                 ((600, 1), 1.0, 15.0)])
def test_xrays_have_their_pixels_aspect_and_those_of_a_line_are_seen(tmp_path, shape, pixel, ratio):
    panel(tmp_path / "p.png", np.zeros(GRID.shape), GRID, np.full((1, *shape), np.nan), pixel=pixel)
    page = matplotlib.image.imread(tmp_path / "p.png")
    seen = np.argwhere(np.abs(page[..., :3] - [1, 0, 1]).max(2) < 0.01)
    high, wide = np.ptp(seen, axis=0) + 1
    assert high / wide == pytest.approx(ratio, rel=0.2)


def test_method_panel_shows_each_method_in_its_column(tmp_path):
    right = air_with_block(HIGH, MIDDLE, MIDDLE)
    left = air_with_block(slice(3, 11), MIDDLE, MIDDLE)
    method_panel(tmp_path / "m.png", {"a": left, "b": right}, right, GRID, {"a": "20.0 dB, SSIM 0.50"}, "methods")
    panels = panels_of(tmp_path / "m.png")
    assert len(panels) == 6
    sides = [centre_of(bright)[1] < 0.5 for bright in panels]
    assert sides == [True, True, False, False, True, True]


def test_bad_input_is_named(tmp_path):
    volume = np.zeros(GRID.shape)
    with pytest.raises(ValueError, match="own grid"):
        panel(tmp_path / "p.png", volume[:8], GRID)
    with pytest.raises(ValueError, match="pass one case"):
        panel(tmp_path / "p.png", np.stack([volume, volume]), GRID)
    with pytest.raises(ValueError, match="pass xrays"):
        panel(tmp_path / "p.png", volume, GRID, reprojection=np.ones((2, 4, 4)))
    with pytest.raises(ValueError, match="re-projection has shape"):
        panel(tmp_path / "p.png", volume, GRID, np.ones((2, 4, 4)), np.ones((3, 4, 4)))
    with pytest.raises(ValueError, match="captions"):
        method_panel(tmp_path / "m.png", {"a": volume}, None, GRID, {"b": ""})
    with pytest.raises(ValueError, match="no volumes"):
        method_panel(tmp_path / "m.png", {}, volume, GRID)


def test_a_page_that_the_disk_cannot_hold_leaves_the_one_before(tmp_path):
    page = tmp_path / "p.png"
    panel(page, air_with_block(HIGH, HIGH, MIDDLE), GRID)
    before, limits = page.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # no file may grow beyond 1000 bytes
    try:
        with pytest.raises(OSError):
            panel(page, air_with_block(MIDDLE, MIDDLE, MIDDLE), GRID)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert page.read_bytes() == before and [*tmp_path.iterdir()] == [page]


def test_a_page_is_a_png_under_any_name(tmp_path):
    for name in ("p", "p.jpg"):
        panel(tmp_path / name, air_with_block(HIGH, HIGH, MIDDLE), GRID)
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert len([*tmp_path.iterdir()]) == 2


@pytest.mark.parametrize("title", ["$\\frac$ and $x", "a long name " * 20, "\udcff \0 \u202e 肺 two\nlines"])
def test_any_title_stands_whole_above_the_planes(tmp_path, title):
    panel(tmp_path / "p.png", air_with_block(HIGH, HIGH, MIDDLE), GRID, title=title)
    ink = matplotlib.image.imread(tmp_path / "p.png")[:40, :, :3].min(2) < 0.5
    assert ink.any() and not ink[:, [0, 1, -2, -1]].any() and not ink[[0, -1]].any()
