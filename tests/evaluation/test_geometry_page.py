"""The page of a dry run names the sides of the body rightly and tells a flipped image from an upright one."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest
import torch

from phydict.datasets import Thorax, build
from phydict.grid import Grid
from phydict.inference.geometry_page import agreement, body_side, geometry_page, view_sides
from phydict.units import hu_to_mu
from phydict.xray import ConeBeam, Projector

GRID = Grid.cube(32)
BEAM = ConeBeam.orbit(4, 1020.0, 740.0, (40, 40), 15.0)


@pytest.fixture(scope="module")
def thorax():
    hu = build(Thorax.standard(), GRID)[0]
    return hu, Projector(GRID, BEAM)(hu_to_mu(torch.from_numpy(hu))[None, None])[0].numpy()


@pytest.mark.parametrize("direction, said", [
    ((1, 0, 0), "right"), ((-3, 0, 0), "left"), ((0, 2, 0), "anterior"), ((0, -1, 0.2), "posterior"),
    ((0, 0, 5), "superior"), ((0, 0, -1), "inferior"), ((-1, -2, 0), "posterior left"),
    ((0.5, 0.1, -1), "inferior right")])
def test_a_direction_is_called_by_the_side_it_points_to(direction, said):
    assert body_side(direction) == said


def test_the_views_of_an_orbit_are_pa_left_ap_right():
    sides = view_sides(BEAM, GRID)
    assert [side.split(",")[0] for side in sides] == ["source posterior", "source left", "source anterior",
                                                      "source right"]
    assert "columns to left, rows to inferior" in sides[0] and "columns to anterior" in sides[1]


def test_the_standard_thorax_has_its_heart_left_its_liver_right_and_its_spine_behind(thorax):
    hu = thorax[0]
    soft, bone = (hu > -50).astype(float), (hu > 90).astype(float)
    middle, low = slice(12, 18), slice(4, 8)
    assert soft[4:16, 14:26, middle].sum() > 1.2 * soft[16:28, 14:26, middle].sum()  # index 0 is left
    assert np.median(np.argwhere(bone[12:20, :, middle])[:, 1]) < 12
    assert hu[18:24, 12:20, low].mean() > hu[8:14, 12:20, low].mean()


@pytest.mark.parametrize("turn, name", [((-1, 1), "flip_rows"), ((1, -1), "flip_columns"),
                                        ((-1, -1), "flip_rows and flip_columns")])
def test_a_flip_is_named_in_every_view_that_shows_it(thorax, turn, name):
    rows, columns = turn
    for k, image in enumerate(thorax[1]):
        assert agreement(40 - 3 * -image, image) == "agreement 1.00"  # whatever gain and offset
        said = agreement(image[::rows, ::columns], image)
        if name == "flip_columns" and k in (0, 2):
            continue  # a frontal thorax is nearly its own mirror image
        assert said.endswith(f"better (1.00) with {name} changed"), (k, said)


def test_an_inverted_view_is_called_inverted_and_not_flipped(thorax):
    for image in thorax[1]:
        assert agreement(-image, image) == "agreement -1.00, better (1.00) inverted"


def test_the_page_shows_every_view_and_refuses_images_of_another_beam(thorax, tmp_path):
    hu, images = thorax
    geometry_page(tmp_path / "deep" / "page.png", BEAM, GRID, images, images, hu, "anna")
    page = matplotlib.image.imread(tmp_path / "deep" / "page.png")
    assert min(page.shape[:2]) > 900 and page[..., :3].std() > 0.1
    geometry_page(tmp_path / "fewer.png", BEAM.select([0]), GRID, images[:1], images[:1], hu)
    with pytest.raises(ValueError, match=r"\(3, 40, 40\) were given for a beam of \(4, 40, 40\)"):
        geometry_page(tmp_path / "page.png", BEAM, GRID, images[:3], images, hu)


def test_a_picture_that_is_no_page_is_not_replaced(thorax, tmp_path):
    hu, images = thorax
    file = tmp_path / "anna.png"
    matplotlib.image.imsave(file, images[0])
    before = file.read_bytes()
    with pytest.raises(ValueError, match="anna.png is there already, is no page of this kind, and is not replaced"):
        geometry_page(file, BEAM, GRID, images, images, hu)
    assert file.read_bytes() == before
    file.unlink()
    for title in ("first", "second"):  # which takes the first one's place
        geometry_page(file, BEAM, GRID, images, images, hu, title)
    assert [*tmp_path.iterdir()] == [file]
