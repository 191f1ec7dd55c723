"""Training a refiner: scenes that can be reconstructed, a resumed run that is the uninterrupted one, and its file."""

from pathlib import Path

import numpy as np
import pytest
import torch
from command_lines import refiner_arguments, refusal, resumed_as_uninterrupted
from prior.tiny import tiny_prior
from torch.nn.functional import avg_pool3d, interpolate
from torch.utils.data import default_collate

from phydict.cli.train import main
from phydict.datasets import phantom_case
from phydict.grid import Cube, Grid
from phydict.methods import reconstruct
from phydict.posterior.measurement import Measurement
from phydict.prior import Refiner, load_prior, save_prior
from phydict.runtime.warning import warn
from phydict.training.data import PriorData
from phydict.training.refiner import RefinerTraining
from phydict.training.scenes import PHOTONS, Scenes
from phydict.training.settings import Loading
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector, checks
from phydict.xray.finer import FinerProjector

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "refiner.yaml"


@pytest.fixture(scope="module")
def prior_file(tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(tiny_prior(detail=True), file, dtype=torch.float32)
    return str(file)


def arguments(folder: Path, cache: Path, initial: str, *more: str) -> list[str]:
    return refiner_arguments(CONFIG, folder, cache, initial, "--model.validation.views=[2]", *more)


def test_a_resumed_run_is_the_uninterrupted_one_and_is_exported_as_a_refiner(tmp_path, cache, prior_file):
    last = resumed_as_uninterrupted(main, lambda run, *more: arguments(
        run, cache, prior_file, "--trainer.limit_val_batches=0", *more), tmp_path)
    main(["export", "--checkpoint", str(last), "--out", str(tmp_path / "refiner.safetensors")])
    refiner = load_prior(tmp_path / "refiner.safetensors")
    assert isinstance(refiner, Refiner) and refiner.entrance.weight.any() and refiner.gate[-1].weight.any()
    begun = load_prior(prior_file).state_dict()
    for name, weight in refiner.first.state_dict().items():
        torch.testing.assert_close(weight, begun[name], rtol=1e-3, atol=1e-6)  # written in half precision
    beam = ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)
    y = Projector(Grid.cube(16), beam, full_detector=True)(torch.full((1, 1, 16, 16, 16), 0.01))[0]
    found = reconstruct(y, beam, refiner, "phydict_learned", report="Small nodule.")
    assert found.volume.isfinite().all()


def test_steps_on_one_batch_lower_its_loss(prior_file):
    task = RefinerTraining(cube=Cube(16), window=(-1000, 600), initial=prior_file)
    batch = default_collate([phantom_case(3, Grid.cube(16), HUWindow(-1000, 600))])
    optimizer = torch.optim.Adam([w for w in task.parameters() if w.requires_grad], 3e-3)
    found = []
    for _ in range(10):
        found.append(task.batch_loss(batch, (1,)))
        optimizer.zero_grad()
        found[-1].backward()
        optimizer.step()
    assert found[-1] < found[0] - 0.3


def test_masks_that_are_not_known_teach_nothing(prior_file):
    task = RefinerTraining(cube=Cube(16), window=(-1000, 600), initial=prior_file)
    case = phantom_case(3, Grid.cube(16), HUWindow(-1000, 600))
    case["has_masks"] = torch.tensor([True, False, False])
    other = case | {"masks": case["masks"] * torch.tensor([1.0, 0.0, 0.5])[:, None, None, None]}
    with torch.no_grad():
        one, same, known = (float(task.batch_loss(default_collate([drawn]), (1,))) for drawn in (
            case, other, case | {"masks": 1 - case["masks"]}))
    assert one == same != known


def test_more_views_than_degrees_can_be_drawn():
    scenes = Scenes(most_views=1000, orbit=0.0, arc=0.0)
    assert max(scenes.beam(np.random.default_rng(seed), Grid.cube(16)).views for seed in range(40)) > 360


def test_nobody_is_warned_of_what_a_scene_was_drawn_with(recwarn, monkeypatch):
    monkeypatch.setattr(checks, "check_line_integrals", lambda y: warn("these line integrals are doubtful"))
    scenes, grid, ct = Scenes(), Grid.cube(16), torch.zeros(1, 1, 16, 16, 16)
    scenes.measure(ct, np.random.default_rng(0), grid, HUWindow())
    assert not recwarn.list
    y, projector = scenes.xrays(ct, np.random.default_rng(0), grid, HUWindow())
    with pytest.warns(UserWarning, match="doubtful"):
        Measurement(projector, y, HUWindow())


def test_every_drawn_scene_can_be_reconstructed_on_its_grid():
    seen = set()
    for grid in (Grid.cube(64), Grid.cube(32, 192)):
        for seed in range(150):
            beam = Scenes().beam(np.random.default_rng(seed), grid)
            beam.check(grid)
            seen.add(beam.views)
            tilted = Scenes(tilted=1.0).beam(np.random.default_rng(seed), grid)
            tilted.check(grid)
            assert beam.is_upright(grid) and not tilted.is_upright(grid)
    assert min(seen) == 1 and max(seen) > 24


@pytest.mark.parametrize("kind", ["misplaced", "scatter", "counting"])
def test_what_befalls_a_scene_is_of_its_kind_and_the_stated_geometry_stays(kind):
    grid, window = Grid.cube(16), HUWindow(-1000, 600)
    ct = phantom_case(3, grid, window)["volume"][None]
    quiet = {"noise": (1e-9, 2e-9), "model_error": 0.0, "most_views": 4}
    for seed in range(6):
        stated = Scenes(**quiet).xrays(ct, np.random.default_rng(seed), grid, window)[1]
        y, projector = Scenes(**quiet | {kind: 1.0}).xrays(ct, np.random.default_rng(seed), grid, window)
        assert stated.beam.same_as(projector.beam) and y.isfinite().all()
        exact = projector(window.to_mu(ct))[0].double()
        error = y.double() - exact
        if kind == "misplaced":  # by millimetres
            assert error.std() > 1e-3 * exact.max() and error.mean().abs() < 0.05 * exact.mean()
        if kind == "scatter":  # adds to what is left of the rays
            assert error.mean() < -0.005 and ((-y.double()).exp() - (-exact).exp()).mean() > 0
        if kind == "counting":  # more where less is left
            assert (error.square() * (-exact).exp()).mean() < 1.5 / PHOTONS[0]


def test_scenes_scale_with_the_grid():
    one, half = (Scenes().beam(np.random.default_rng(4), Grid.cube(64, side)) for side in (384, 192))
    np.testing.assert_allclose(one.sources, 2 * half.sources)
    np.testing.assert_allclose(one.u, 2 * half.u)


@pytest.mark.parametrize("settings, words", [
    ({"most_views": 0}, "between 1 and 1,000"), ({"arc": 1.2}, "arc lies between"), ({"orbit": 0.8}, "at most 1"),
    ({"noise": (0.1, 0.01)}, "least <= most")])
def test_scenes_that_cannot_be_drawn_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        Scenes(**settings)


def test_a_prior_of_another_grid_is_refused(tmp_path, cache, prior_file, capsys):
    args = arguments(tmp_path, cache, prior_file, "--model.cube.voxels=32")
    assert "another grid or HU window" in refusal(capsys, main, args)


def test_fine_xrays_of_blocks_are_those_of_their_means_where_rays_cannot_tell():
    grid, rng = Grid.cube(16), torch.Generator().manual_seed(0)
    projector = Projector(grid, ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0), full_detector=True)
    smooth = interpolate(torch.rand((1, 1, 3, 3, 3), generator=rng), (32, 32, 32), mode="trilinear") * 0.02
    coarse, fine = projector(avg_pool3d(smooth, 2)), FinerProjector(projector)(smooth)
    np.testing.assert_allclose(projector.beam.divided(2).binned(2).pixels(), projector.beam.pixels())
    assert fine.shape == coarse.shape
    assert (fine - coarse).abs().mean() < 0.02 * coarse.mean()
    grain = smooth + 0.02 * torch.rand((1, 1, 32, 32, 32), generator=rng)
    lost = (FinerProjector(projector)(grain) - projector(avg_pool3d(grain, 2))).abs().mean()
    assert lost > 1.2 * (fine - coarse).abs().mean()


def test_learnt_volumes_are_means_of_what_their_xrays_are_made_of(cache):
    data = PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(simulation_voxels=32))
    batch = data.collate([data.draws(0)[0]])
    torch.testing.assert_close(batch["volume"], avg_pool3d(batch["fine"], 2))
    assert batch["fine"].shape[2:] == (32, 32, 32) and batch["masks"].shape[2:] == (16, 16, 16)
    ct, others = batch["volume"], (Grid.cube(16), HUWindow(-1000, 600), batch["fine"])
    made = [Scenes(fine=share).measure(ct, np.random.default_rng(3), *others).y for share in (0, 1)]
    assert made[0].shape == made[1].shape and not torch.equal(*made)
    with pytest.raises(ValueError, match="multiple of model.cube.voxels, 16, but 40"):
        PriorData(phantoms=2, cache=str(cache), cube=Cube(16), loading=Loading(simulation_voxels=40))


def test_a_refiner_learns_from_xrays_of_finer_volumes(tmp_path, cache, prior_file):
    main(arguments(tmp_path, cache, prior_file, "--data.loading.simulation_voxels=32", "--model.scenes.fine=1",
                   "--trainer.max_epochs=1"))
    assert (tmp_path / "last.ckpt").is_file()


@pytest.mark.parametrize("noise", [(0.02, 0.03), (1e-4, 2e-4)])
def test_no_scene_has_more_or_less_noise_than_its_range(noise):
    grid, window = Grid.cube(16), HUWindow(-1000, 600)
    ct, scenes = torch.zeros(1, 1, *grid.shape), Scenes(noise=noise, model_error=0.0, most_views=2)
    for seed in range(8):
        y, projector = scenes.xrays(ct, np.random.default_rng(seed), grid, window)
        exact = projector(window.to_mu(ct))[0]
        assert 0.9 * noise[0] < (y - exact).std() / exact.max() < 1.1 * noise[1]
