"""CTs in MetaImage and NRRD files are those of the same voxels in NIfTI, and what is wrong with one is said."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from ct_files import save_ct, thorax_hu

from phydict.datasets.cts.ct_rate import CTCases, find_cts
from phydict.datasets.cts.reading import load_ct
from phydict.datasets.cts.sources import find_sources
from phydict.datasets.itk_file import ENDINGS, voxel_files
from phydict.grid import Grid
from phydict.units import HUWindow

SimpleITK = pytest.importorskip("SimpleITK")
TURNED = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def save_itk(path: Path, volume: np.ndarray, vector: bool = False) -> Path:
    """A volume (X, Y, Z) whose axes run anterior to posterior, left to right and up."""
    image = SimpleITK.GetImageFromArray(volume.T, isVector=vector)
    image.SetSpacing((2.0, 3.0, 4.0))
    image.SetOrigin((50.0, -20.0, 7.0))
    image.SetDirection((-TURNED).ravel().tolist() if volume.ndim == 3 else np.eye(3).ravel().tolist())
    SimpleITK.WriteImage(image, str(path))
    return path


def test_other_voxels_beside_the_same_header_are_another_ct(tmp_path):
    path, known = tmp_path / "ct.mhd", set()
    for shift in (0, 100):
        save_itk(path, thorax_hu().astype(np.int16) + np.int16(shift))
        assert voxel_files(path) == [tmp_path / "ct.raw"]
        [ct], [source] = find_cts(path), find_sources(path)
        known.add((CTCases([ct], tmp_path, Grid.cube(16), HUWindow()).key(ct), str(source.fingerprint())))
    assert len(known) == 2 and len({key for key, _ in known}) == 2
    path.write_text(path.read_text().replace("ct.raw", "LOCAL"))
    assert voxel_files(path) == [] == voxel_files(tmp_path / "ct.raw")


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_of_itks_gives_what_the_same_voxels_in_nifti_give(tmp_path, ending):
    volume = thorax_hu().astype(np.int16)[:40, :36, :30]
    path = save_itk(tmp_path / f"ct{ending}", volume)
    affine = np.eye(4)
    affine[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ (-TURNED * [2.0, 3.0, 4.0])  # ITK's world is LPS
    affine[:3, 3] = -50.0, 20.0, 7.0
    nifti = load_ct(save_ct(tmp_path / "same" / "ct.nii.gz", volume, affine))
    for found, same in zip(load_ct(path), nifti):
        np.testing.assert_allclose(found, same, atol=1e-5)
    assert [(ct.path, ct.id) for ct in find_cts(path)] == [(path, "ct")]


def test_a_folder_is_read_for_them_where_it_holds_no_nifti_and_no_series(tmp_path):
    volume = thorax_hu().astype(np.int16)
    for name in ("a.mhd", "b.nrrd"):
        save_itk(tmp_path / name, volume)
    assert [ct.id for ct in find_cts(tmp_path)] == [source.id for source in find_sources(tmp_path)] == ["a", "b"]
    save_ct(tmp_path / "c.nii.gz", volume)
    assert [ct.id for ct in find_cts(tmp_path)] == ["c"]


def test_what_is_wrong_with_one_is_said_in_a_sentence(tmp_path, monkeypatch):
    volume = thorax_hu().astype(np.int16)
    path = save_itk(tmp_path / "ct.mhd", volume)
    (tmp_path / "ct.raw").write_bytes((tmp_path / "ct.raw").read_bytes()[:1000])
    colours, flat = tmp_path / "colours.mha", save_itk(tmp_path / "flat.mha", volume[..., :3])
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(np.zeros((9, 9, 9, 3), np.uint8), isVector=True), str(colours))
    for file, sentence in ((path, "ct.mhd cannot be read"), (colours, "3 numbers per voxel"),
                           (flat, "3 slices.* give the whole series")):
        with pytest.raises(ValueError, match=sentence) as error:
            load_ct(file)
        assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(ValueError, match=r"SimpleITK, which reads it, is not installed: pip install 'phydict\[itk\]'"):
        load_ct(path)
