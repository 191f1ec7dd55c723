"""Draws of a training: kept ones come as often as asked and are the same whoever made them, finer ones are averaged."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_lines import arguments
from torch.nn.functional import avg_pool3d

from phydict.cli.train import main
from phydict.grid import Cube
from phydict.training.crops import Crops, SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.draws import ALL_NEW, KeptDraws
from phydict.training.reconstructions import RefinementCases, RefinementData
from phydict.training.rollouts import RollOutData, RollOutSettings
from phydict.training.scenes import Scenes
from phydict.training.settings import Loading


def kept(folder, reuse=4, seed=0, epoch=0, length=100):
    return KeptDraws([], folder, reuse, length, epoch, seed)


@pytest.mark.parametrize("reuse", [2, 5, 16])
def test_each_draw_is_new_once_and_given_as_often_as_asked(reuse, tmp_path):
    numbers = [kept(tmp_path, reuse).number(item) for item in range(ALL_NEW + reuse * 3000)]
    assert numbers[:ALL_NEW + 1] == list(range(ALL_NEW + 1))
    newest = np.maximum.accumulate(numbers)
    assert (np.diff(newest) <= 1).all(), "none is left out, and none is given before it is new"
    given = np.bincount(numbers)[ALL_NEW:-500]  # the last have not been given that often yet
    assert abs(given.mean() - reuse) < 0.25 * reuse


def test_a_kept_draw_is_the_same_in_another_epoch_process_and_order(tmp_path, cache):
    data = PriorData(phantoms=3, cache=str(cache / "kept"), cube=Cube(16), loading=Loading(reuse=3, epoch_size=4))
    first, second = data.draws(0), data.draws(1)
    late = second.draw(6)  # before those that come first
    for draws, item in ((second, 2), (KeptDraws(None, first.folder, 3, 4, 1, data.seed), 2)):
        assert draws.number(4 + item) == 6
        again = draws[item]
        assert again["report"] == late["report"]
        assert all(torch.equal(again[part], late[part]) for part in ("volume", "masks", "has_masks"))
    fresh = PriorData(phantoms=3, cache=str(cache / "kept"), cube=Cube(16), loading=Loading()).draws(0)[6]
    assert (late["volume"] - fresh["volume"]).abs().max() < 1e-3, "half precision is all that keeping costs"
    assert (late["masks"] - fresh["masks"]).abs().max() <= 0.5 / 255 + 1e-6


def test_draws_of_other_settings_are_kept_elsewhere(cache, monkeypatch):
    data = [PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(reuse=2), seed=seed).draws(0).folder
            for seed in (0, 1)]
    other = PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(reuse=2))
    other.augmentation = replace(other.augmentation, rotation=1.0)
    more = PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(reuse=7, epoch_size=9))
    assert len({*data, other.draws(0).folder}) == 3
    assert more.draws(3).folder == data[0], "how often and in which order they come does not change what they are"
    monkeypatch.setattr("phydict.training.data.DRAW_VERSION", 0)
    assert more.draws(3).folder not in data, "what another version made is not taken for what this one makes"


def test_cases_drawn_on_finer_voxels_are_the_means_of_their_blocks(cache):
    fine = PriorData(phantoms=2, cache=str(cache), cube=Cube(32), loading=Loading()).draws(0)[0]
    averaged = PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(draw_voxels=32)).draws(0)[0]
    for part in ("volume", "masks"):
        torch.testing.assert_close(averaged[part], avg_pool3d(fine[part], 2))
    both = PriorData(phantoms=2, cache=str(cache), cube=Cube(8), loading=Loading(simulation_voxels=16, draw_voxels=32))
    batch = both.collate([both.draws(0)[0]])
    torch.testing.assert_close(batch["fine"][0], averaged["volume"])
    torch.testing.assert_close(batch["volume"][0], avg_pool3d(averaged["volume"], 2))


def test_voxels_that_do_not_fit_are_refused(cache):
    with pytest.raises(ValueError, match="draw_voxels is a multiple of the voxels that are trained on, 32, but 48 was"):
        PriorData(phantoms=1, cache=str(cache), cube=Cube(16), loading=Loading(simulation_voxels=32, draw_voxels=48))


@pytest.mark.parametrize("loading, named", [(Loading(reuse=2), "reuse is 2"), (Loading(draw_voxels=32), "draw_voxels")])
def test_stages_with_draws_of_their_own_refuse_what_they_would_not_heed(loading, named, cache):
    with pytest.raises(ValueError, match=f"in its own way, but data.loading.{named}.*: leave it out"):
        RollOutData(phantoms=1, cache=str(cache), cube=Cube(16), loading=loading)


def test_a_prior_is_trained_on_kept_draws(tmp_path, cache):
    main(arguments(tmp_path / "run", cache, "--data.loading.reuse=2", "--data.loading.draw_voxels=32",
                   "--trainer.max_epochs=1", "--trainer.limit_val_batches=0"))
    assert (tmp_path / "run" / "last.ckpt").is_file()


DATA = {
    "cases": lambda more, file: PriorData(cube=Cube(16), **more),
    "kept": lambda more, file: PriorData(cube=Cube(16), loading=Loading(draw_voxels=32, reuse=2), **more),
    "crops": lambda more, file: SuperResolutionData(Crops(8, 2), cube=Cube(16), **more),
    "calls": lambda more, file: RollOutData(RollOutSettings(1, Scenes(most_views=3), file), cube=Cube(16),
                                            window=(-1000, 600), **more),
    "results": lambda more, file: RefinementData(RefinementCases(1, 1, 16), Scenes(most_views=3), initial=file,
                                                 cube=Cube(32), window=(-1000, 600), **more)}


@pytest.mark.parametrize("kind", DATA)
def test_processes_that_are_not_forked_draw_the_same(kind, cache, refiner_file):
    data = DATA[kind]({"phantoms": 2, "cache": str(cache)}, refiner_file)
    data.trainer = SimpleNamespace(is_global_zero=True, callback=lambda: "cannot be sent to another process")
    draws, collate = pickle.loads(pickle.dumps((data.draws(0), data.collate)))
    ours, theirs = data.collate([data.draws(0)[0]]), collate([draws[0]])
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        same = value.equal(theirs[name]) if isinstance(value, torch.Tensor) else value == theirs[name]
        assert same, name
