"""Crops for the super-resolution stage: where they are cut, what augmentation keeps, and what the cache survives."""

import resource
from itertools import product

import nibabel
import numpy as np
import pytest
import torch
from ct_files import save_ct, thorax_hu

from phydict.datasets import find_cts, load_case, phantom_case, prepare_ct
from phydict.datasets.cts.cache import write_array
from phydict.datasets.cts.preparation import prepare_folder
from phydict.datasets.cts.spaces import Settings
from phydict.grid import Cube, Grid
from phydict.training.crops import CropDataset, CTVolumes, PhantomVolumes, SuperResolutionData
from phydict.training.made import mapped_volume
from phydict.training.settings import Crops, HoldOut, Loading
from phydict.units import HUWindow

RAMP = (np.arange(16**3).reshape(16, 16, 16) / 16**3).astype(np.float16)


def crops(size=8, align=4, augmented=False, seed=0, epoch=0):
    return CropDataset([], [RAMP], 0.0, HUWindow(), size, align, 40, epoch, seed, augmented)


def test_a_crop_is_a_piece_of_its_volume_that_starts_at_a_whole_coarse_voxel():
    found = crops()
    starts = set()
    for i in range(len(found)):
        piece = found[i]["volume"][0].numpy()
        same = [start for start in product((0, 4, 8), repeat=3)
                if np.array_equal(piece, RAMP[tuple(slice(s, s + 8) for s in start)].astype(np.float32))]
        assert len(same) == 1
        starts.update(same)
    assert len(starts) > 15  # of 27


def test_a_draw_depends_on_seed_epoch_and_place_alone():
    one, again = crops(augmented=True), crops(augmented=True)
    assert all(torch.equal(one[i]["volume"], again[i]["volume"]) for i in range(10))
    for other in (crops(augmented=True, seed=1), crops(augmented=True, epoch=1)):
        assert not all(torch.equal(one[i]["volume"], other[i]["volume"]) for i in range(10))


def test_augmentation_mirrors_and_changes_hu_a_little_but_never_air():
    plain, changed = crops(), crops(augmented=True)
    mirrored = 0
    for i in range(len(plain)):
        old, new = HUWindow().to_hu(plain[i]["volume"]), HUWindow().to_hu(changed[i]["volume"])
        straight, flipped = (float((new - o).abs().max()) for o in (old, old.flip(1)))
        assert min(straight, flipped) < 0.03 * 2000 + 20 + 1
        mirrored += flipped < straight
    assert 8 < mirrored < 32
    air = CropDataset([], [np.full((16, 16, 16), -1, np.float16)], 0.0, HUWindow(), 8, 4, 3, 0, 0)
    assert all((air[i]["volume"] == -1).all() for i in range(3))


def test_mere_air_is_rarely_drawn():
    volume = np.full((32, 32, 32), -1, np.float16)
    volume[:16] += np.random.default_rng(0).random((16, 32, 32)).astype(np.float16)
    drawn = CropDataset([], [volume], 0.0, HUWindow(), 8, 4, 100, 0, 0, False)
    assert sum(float(drawn[i]["volume"].std()) < 0.05 for i in range(100)) < 20


def test_a_volume_that_the_disk_cannot_hold_is_one_sentence_and_leaves_nothing(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # no file may grow beyond 1000 bytes
    try:
        with pytest.raises(OSError, match="a.npy of the cache could not be written .*: give another data.cache"):
            mapped_volume(tmp_path / "a.npy", lambda: torch.zeros(8, 8, 8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not [*tmp_path.iterdir()]


def test_a_volume_is_made_once_and_again_when_its_file_is_damaged(tmp_path):
    made = []

    def make():
        made.append(1)
        return torch.full((4, 5, 6), 0.25)

    file = tmp_path / "folder" / "a.npy"
    for _ in range(2):
        assert (mapped_volume(file, make) == 0.25).all()
    assert len(made) == 1 and [f.name for f in file.parent.iterdir()] == ["a.npy"]
    file.write_bytes(file.read_bytes()[:150])
    with pytest.warns(match="prepared again"):
        assert (mapped_volume(file, make) == 0.25).all() and len(made) == 2


def test_a_volume_that_cannot_be_made_leaves_nothing(tmp_path):
    def fail():
        raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space"):
        mapped_volume(tmp_path / "a.npy", fail)
    assert not list(tmp_path.iterdir())


def test_phantoms_are_those_of_the_base_stage(tmp_path):
    volume = PhantomVolumes(7, 1, Grid.cube(16), HUWindow(), tmp_path)[0]
    expected = phantom_case(7, Grid.cube(16), HUWindow())["volume"][0].numpy().astype(np.float16)
    np.testing.assert_array_equal(volume, expected)


def test_prepared_cases_are_read_as_they_were_prepared_and_never_made_finer(tmp_path):
    save_ct(tmp_path / "in/a.nii.gz", thorax_hu())
    prepare_folder(tmp_path / "in", tmp_path / "out", Settings(voxels=32))
    cts, grid = find_cts(tmp_path / "out"), Grid.cube(32)
    volumes = CTVolumes(cts, tmp_path / "cache", grid, HUWindow())
    anew = prepare_ct(cts[0].path, grid, HUWindow())["volume"][0].numpy().astype(np.float16)
    write_array(tmp_path / "cache" / f"a-{volumes.key(cts[0])}.npy", anew)  # where a volume prepared once more was kept
    expected = load_case(cts[0], grid, HUWindow())["volume"][0].numpy().astype(np.float16)
    assert not np.array_equal(volumes[0], anew) and np.array_equal(volumes[0], expected)
    data = SuperResolutionData(Crops(8, 2), str(tmp_path / "out"), holdout=HoldOut(phantoms=0), phantoms=0,
                               loading=Loading(epoch_size=1, ct_fraction=1.0), cache=str(tmp_path / "cache"),
                               cube=Cube(64))
    with pytest.raises(ValueError, match="a was prepared with voxels of 12 mm, but 6 mm are needed; .* --voxels 64"):
        data.draws(0)[0]


def test_held_out_cts_alone_validate_on_fixed_crops(tmp_path):
    for n in range(2):
        hu = np.full((20, 20, 20), -1000, np.int16)
        hu[4:16, 6:15, :] = 40 + 300 * n
        image = nibabel.Nifti1Image(hu, np.diag([10.0, 10.0, 10.0, 1.0]))
        image.set_sform(image.affine, code=1)
        (tmp_path / "cts").mkdir(exist_ok=True)
        nibabel.save(image, tmp_path / "cts" / f"patient{n}.nii.gz")
    data = SuperResolutionData(Crops(8, 4, 3), str(tmp_path / "cts"), holdout=HoldOut(["patient1"], phantoms=1),
                               phantoms=0, loading=Loading(epoch_size=10, ct_fraction=1.0),
                               cache=str(tmp_path / "cache"), cube=Cube(16))
    assert [ct.id for ct in data.cts.cts] == ["patient0"] and len(data.validation) == 3 + 3
    bone = float(HUWindow().to_range(torch.tensor(340.0)))
    assert max(float(data.validation[i]["volume"].max()) for i in (3, 4, 5)) == pytest.approx(bone, abs=1e-3)
    epoch = data.draws(0)
    assert max(float(epoch[i]["volume"].max()) for i in range(10)) < bone - 0.1
    assert torch.equal(data.validation[4]["volume"], data.validation[4]["volume"])


@pytest.mark.parametrize("crop, factor", [(10, 4), (20, 4), (0, 4)])
def test_a_crop_that_cannot_be_is_refused(crop, factor, tmp_path):
    with pytest.raises(ValueError, match="data.crops.size is a multiple"):
        SuperResolutionData(Crops(crop, factor), phantoms=1, cube=Cube(16), cache=str(tmp_path))


@pytest.mark.parametrize("wrong, option", [({"factor": 0}, "model.factor"), ({"factor": -4}, "model.factor"),
                                           ({"validation": -1}, "data.crops.validation")])
def test_settings_of_crops_that_cannot_be_are_refused_by_their_option(wrong, option):
    with pytest.raises(ValueError, match=f"^{option} .*, but {next(iter(wrong.values()))} was given$"):
        Crops(**wrong)


def test_crops_are_drawn_from_volumes_of_one_size_alone(tmp_path):
    with pytest.raises(ValueError, match="data.loading.simulation_voxels is 32: leave it out"):
        SuperResolutionData(Crops(8, 2), phantoms=1, loading=Loading(simulation_voxels=32), cube=Cube(16),
                            cache=str(tmp_path))
