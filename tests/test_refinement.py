"""The network that corrects reconstructions on fine voxels: what it keeps to, its training and its file."""

import re
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_lines import refinement_arguments, refusal, resumed_as_uninterrupted
from ct_files import save_ct, thorax_hu
from fitting import fit_to_grid
from prior.tiny import tiny_correction, tiny_prior, tiny_refiner
from torch.nn.functional import pad

from phydict.cli.train import main
from phydict.datasets import phantom_case
from phydict.evaluation import read_csv
from phydict.grid import Cube, Grid
from phydict.methods import METHODS, corrections_of, reconstruct, reconstructor
from phydict.posterior import ProximalCG, Refined, Refinement, Unrolled, refined
from phydict.posterior.coarse_correction import coarse_correction
from phydict.prior import DEFAULT_REFINER, load_correction, local_unet, save_prior, save_stage
from phydict.prior.correction import INPUTS, CorrectionNetwork
from phydict.runtime.profiling import profiled
from phydict.runtime.warning import Remark
from phydict.training.reconstructions import RefinementCases, RefinementData
from phydict.training.refinement import RefinementTraining
from phydict.training.scenes import Scenes
from phydict.training.settings import HoldOut
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "refinement.yaml"
FINE, WINDOW = Grid.cube(32), HUWindow(-1000, 600)
BEAM = ConeBeam.orbit(3, 1020, 740, (56, 56), 10.0)


def reconstructed(network: CorrectionNetwork | None, refinement: Refinement = Refinement(), order=(0, 1, 2),
                  precision: str = "auto"):
    xrays = Projector(FINE, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *FINE.shape))[0]
    base = reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner(), precision=precision)
    ready = Refined(base, FINE, refinement, (network,) if network else ())
    return ready.reconstruct(*fit_to_grid(ready, FINE, xrays[list(order)], BEAM.select(list(order))))


@pytest.mark.parametrize("shape", [(32, 24, 20), (30, 21, 17)])
def test_slab_by_slab_the_correction_is_that_of_the_whole(monkeypatch, shape):
    corrects, seen = tiny_correction(), torch.randn(1, INPUTS, *shape)
    torch.nn.init.normal_(corrects.join.weight, std=0.3)
    whole = corrects(seen)
    for planes in (2, 6, 10):
        monkeypatch.setattr(local_unet, "SLAB_VOXELS", planes * 24 * 20)
        torch.testing.assert_close(corrects(seen), whole, atol=1e-6, rtol=1e-5)


def test_an_untrained_network_corrects_nothing_and_another_grids_takes_no_part():
    z, evidence = torch.rand(1, 1, *FINE.shape) - 0.5, torch.randn(1, INPUTS - 1, *FINE.shape)
    assert tiny_correction(trained=False).corrected(z, evidence).equal(z)
    assert not tiny_correction().corrected(z, evidence).equal(z)
    assert reconstructed(tiny_correction(Grid.cube(128))).volume.equal(reconstructed(None).volume)


def test_the_xrays_are_met_again_after_a_correction():
    alone, met = (reconstructed(tiny_correction(), how) for how in (Refinement(call_step=None), Refinement()))
    assert (alone.volume - reconstructed(None, Refinement(call_step=None)).volume).abs().max() > 10
    assert met.misfit < 0.5 * alone.misfit


@pytest.mark.parametrize("corrects, refinement, calls", [
    (True, Refinement(None), 0), (False, Refinement(calls=0), 0), (True, Refinement(calls=1), 1),
    (True, Refinement(), 3), (False, Refinement(), 2)])
def test_a_refinement_prepares_what_it_uses_and_counts_what_happens(monkeypatch, corrects, refinement, calls):
    prepared = []
    monkeypatch.setattr(refined, "coarse_correction", lambda *given: prepared.append(coarse_correction(*given))
                        or prepared[0])
    with profiled(memory=False) as profile:
        found = reconstructed(tiny_correction() if corrects else None, refinement)
    assert found.network_calls - found.coarse.network_calls == calls
    assert len(prepared) == (calls > corrects) and all(correction.calls for correction in prepared)
    assert found.projector_calls - found.coarse.projector_calls == sum(
        profile.uses[name].calls for name in ("refine / projector", "score / projector"))


@pytest.mark.parametrize("voxels, refinement, corrects, alone", [
    (32, Refinement(), False, []), (48, Refinement(), False, ["24"]), (40, Refinement(), False, ["40"]),
    (32, Refinement(coarse=False), False, ["32"]), (32, Refinement(calls=0), False, ["32"]),
    (32, Refinement(calls=0), True, ["32"]), (32, Refinement(None), False, []),
    (32, Refinement(coarse=False), True, []), (64, Refinement(coarse=False), False, ["32", "64"])])
def test_a_reconstruction_says_where_the_xrays_alone_refine(voxels, refinement, corrects, alone):
    assert remarks(voxels, refinement, corrects) == alone


def test_a_box_of_odd_numbers_of_unequal_voxels_meets_the_xrays_too():
    target = Grid.box((30, 21, 17), (360.0, 252.0, 170.0), (5.0, -10.0, 20.0))
    case = phantom_case(1, FINE, WINDOW)
    xrays = Projector(FINE, BEAM, full_detector=True)(WINDOW.to_mu(case["volume"])[None])[0]
    ready = Refined(reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner()), target, networks=(tiny_correction(),))
    found = ready.reconstruct(*fit_to_grid(ready, target, xrays, BEAM))
    assert found.volume.shape == target.shape and found.grid.same_as(target) and found.misfit < 0.05


def test_of_one_view_and_tilted_detectors_it_says_so_too():
    for beam in (BEAM.select([0]), BEAM.tilted(1)):
        assert remarks(48, Refinement(), beam=beam) == ["24", "48"]


def remarks(voxels: int, refinement: Refinement, corrects: bool = False, beam: ConeBeam = BEAM) -> list[str]:
    """Sizes of what it is said of that no network refines to it, along an axis."""
    target = Grid.cube(voxels)
    xrays = Projector(target, beam, full_detector=True)(0.02 * torch.ones(1, 1, *target.shape))[0]
    base = reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner())
    ready = Refined(base, target, refinement, (tiny_correction(),) if corrects else ())
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        ready.reconstruct(*fit_to_grid(ready, target, xrays, beam))
    said = " ".join(str(warning.message) for warning in warned if warning.category is Remark)
    return re.findall(r"(\d+) x \1 x \1", said)


def test_the_shipped_networks_correct_on_their_own_voxels():
    for grid, lengths in ((Grid.cube(64), []), (Grid.box(64, 192.0), [3]), (Grid.cube(256), [3, 1.5])):
        files = corrections_of(Unrolled(), grid)
        assert [load_correction(file).grid.spacing[0] for file in files] == lengths
        assert corrections_of(METHODS["phydict_fast"], grid) == []


@pytest.mark.filterwarnings("ignore:.* cut the patient off", "ignore:no network has learnt")
def test_networks_of_ones_own_correct_in_place_of_those_shipped(tmp_path):
    file = tmp_path / "mine.safetensors"
    save_stage(tiny_correction(), file, {"steps": 1})
    mine, refiner = Unrolled((0.2,), (0.5, 0.3), corrections=(str(file),)), tiny_refiner()
    xrays = Projector(FINE, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *FINE.shape))[0]
    found = reconstruct(xrays, BEAM, refiner, mine, grid=FINE)
    ready = Refined(reconstructor(mine, refiner), FINE, networks=(load_correction(file),))
    assert found.volume.equal(ready.reconstruct(*fit_to_grid(ready, FINE, xrays, BEAM)).volume)
    with pytest.warns(Remark, match="corrections name networks for finer voxels than these"):
        reconstruct(xrays, BEAM, refiner, mine)
    assert corrections_of(mine, Grid.cube(16)) == [] and corrections_of(mine, FINE) == [file]
    for wrong, words in ((tmp_path / "none.safetensors", "none.safetensors"), (DEFAULT_REFINER, "refine")):
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            reconstruct(xrays, BEAM, refiner, replace(mine, corrections=(str(wrong),)), grid=FINE)
    with pytest.raises(ValueError, match="a list of files, but 'mine.safetensors' was given"):
        replace(mine, corrections="mine.safetensors")


def test_a_refinement_by_a_network_takes_the_memory_that_is_asked_for():
    cost = Path(__file__).parent / "benchmark" / "grid_cost.csv"
    measured = [row["own_mib"] for row in read_csv(cost) if row["voxels"] == 256]
    base = reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner())
    asked = Refined(base, FINE, networks=(tiny_correction(),)).volumes * 256**3 * 4 / 2**20
    assert measured and max(measured) <= asked < 1.5 * min(measured)
    assert Refined(base, FINE).volumes < Refined(base, FINE, networks=(tiny_correction(),)).volumes


@pytest.mark.parametrize("views", [(0,), (0, 1)])
@pytest.mark.parametrize("corrects", [True, False])
def test_from_few_views_total_variation_weighs_less_and_no_coarse_network_corrects(monkeypatch, corrects, views):
    def lighter(step: ProximalCG) -> ProximalCG:
        return replace(step, tv_weight=step.tv_weight * len(views) / 3)

    usual, correction = Refinement(), tiny_correction() if corrects else None
    stated = replace(usual, step=lighter(usual.step), call_step=lighter(usual.call_step), calls=int(corrects),
                     few_views=0)
    monkeypatch.setattr(refined, "coarse_correction", lambda *_: None)
    expected = reconstructed(correction, stated, views)
    monkeypatch.undo()
    found = reconstructed(correction, usual, views)
    assert found.volume.equal(expected.volume) and not found.volume.equal(
        reconstructed(correction, replace(usual, few_views=0), views).volume)
    assert found.network_calls - found.coarse.network_calls == corrects


def test_from_many_views_the_xrays_are_met_more_often_and_a_mirrored_estimate_is_corrected_too():
    usual, met = Refinement(many_views=BEAM.views), ProximalCG(iterations=8, restarts=2, tv_weight=5.0, tv_eps=0.003)
    many = usual.of_views(BEAM.views)
    assert many == replace(usual, call_std=many.call_std, call_step=met) and many.call_std == pytest.approx(0.2)
    found = reconstructed(tiny_correction(), usual)
    assert found.network_calls - found.coarse.network_calls == 5
    assert (found.volume - reconstructed(tiny_correction(), replace(usual, mirrored=False)).volume).abs().max() > 0.1


def test_mirrored_a_network_adds_nothing_to_one_side_that_it_takes_from_the_other():
    class Leaning(CorrectionNetwork):
        def corrected(self, z, evidence, precision="auto"):
            return z + torch.linspace(-0.2, 0.2, z.shape[2])[:, None, None]

    once = Refinement(calls=1, call_step=None, many_views=BEAM.views)
    nothing, leaning = (reconstructed(made, once) for made in (
        tiny_correction(trained=False), Leaning((4, 8), 4, FINE, WINDOW)))
    torch.testing.assert_close(leaning.volume, nothing.volume, atol=0.01, rtol=0)
    one_way = reconstructed(Leaning((4, 8), 4, FINE, WINDOW), replace(once, mirrored=False))
    assert (one_way.volume - nothing.volume).abs().max() > 100


def test_the_first_level_is_met_by_step_and_further_ones_by_call_step():
    class Noted(ProximalCG):
        def __call__(self, measurement, x, *given):
            noted.append((self.tv_weight, x.shape[-1]))
            return super().__call__(measurement, x, *given)

    noted: list[tuple[float, int]] = []
    target, refinement = Grid.cube(64), Refinement(Noted(tv_weight=10.0), call_step=Noted(tv_weight=5.0))
    xrays = Projector(target, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *target.shape))[0]
    ready = Refined(reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner()), target, refinement)
    ready.reconstruct(*fit_to_grid(ready, target, xrays, BEAM))
    first = {size: weight for weight, size in reversed(noted)}
    assert first == {32: 10.0, 64: 5.0}


def test_the_order_of_the_views_changes_nothing():
    one, other = (reconstructed(tiny_correction(), Refinement(calls=1), order, "float32")
                  for order in ((0, 1, 2), (2, 0, 1)))
    torch.testing.assert_close(one.volume, other.volume, atol=4.0, rtol=0)  # HU; CG carries rounding far


def test_a_voxel_depends_on_its_neighbourhood_alone_so_that_a_crop_is_corrected_as_the_whole():
    made, reach = tiny_correction().double(), tiny_correction().reach
    seen = torch.randn(1, INPUTS, 64, 16, 16, dtype=torch.float64)
    changed = pad(seen[..., :reach, :, :], (0, 0, 0, 0, 0, 64 - reach))
    assert made(seen)[0, 0, 0].equal(made(changed)[0, 0, 0])
    assert not made(seen)[0, 0, reach // 2].equal(made(changed)[0, 0, reach // 2])
    crop = made(seen[..., 8:, :, :])[0, 0, reach:]
    torch.testing.assert_close(crop, made(seen)[0, 0, 8 + reach:])


def test_odd_sizes_are_corrected_as_their_voxels_repeated_at_the_end():
    made, seen = tiny_correction(), torch.randn(1, INPUTS, 17, 16, 15)
    torch.testing.assert_close(made(seen), made(pad(seen, (0, 1, 0, 0, 0, 1), mode="replicate"))[..., :17, :, :15])


def test_a_file_holds_the_network_and_no_other_stage_is_taken_for_it(tmp_path):
    save_stage(tiny_correction(), tmp_path / "fine.safetensors", dtype=torch.float32)
    loaded, seen = load_correction(tmp_path / "fine.safetensors"), torch.randn(1, INPUTS, 16, 16, 16)
    assert loaded(seen).equal(tiny_correction()(seen)) and loaded.suits(Grid.cube(16, 192), WINDOW)
    assert loaded.suits(Grid.cube(64), WINDOW) and not loaded.suits(Grid.cube(48), WINDOW)
    assert not loaded.suits(FINE, HUWindow()) and not loaded.suits(Grid.cube(16), WINDOW)
    save_prior(tiny_prior(), tmp_path / "prior.safetensors")
    with pytest.raises(ValueError, match="is a base prior, but a refinement on finer voxels is needed"):
        load_correction(tmp_path / "prior.safetensors")


def test_steps_on_one_crop_lower_its_loss():
    task = RefinementTraining((4, 8), Cube(32), (-1000, 600))
    draw = torch.Generator().manual_seed(0)
    truth = torch.rand(1, 1, 16, 16, 16, generator=draw) - 0.5
    seen = torch.cat([truth + 0.1, torch.randn(1, INPUTS - 1, 16, 16, 16, generator=draw)], 1)
    optimizer, found = torch.optim.Adam(task.parameters(), 1e-2), []
    for _ in range(20):
        found.append(task.batch_loss({"volume": torch.cat([seen, truth], 1), "scale": torch.tensor([[0.01, 0.1]])}))
        optimizer.zero_grad()
        found[-1].backward()
        optimizer.step()
    assert found[-1] < 0.5 * found[0]


def arguments(folder: Path, cache: Path, initial: str, *more: str) -> list[str]:
    return refinement_arguments(CONFIG, folder, cache, initial, "--model.channels=[4,8]", *more)


def test_a_resumed_run_is_the_uninterrupted_one_and_makes_each_reconstruction_once(tmp_path, cache, refiner_file):
    last = resumed_as_uninterrupted(main, lambda run, *more: arguments(run, cache, refiner_file, *more), tmp_path)
    main(["export", "--checkpoint", str(last), "--out", str(tmp_path / "fine.safetensors")])
    assert load_correction(tmp_path / "fine.safetensors").leave.weight.any()
    files = {file: file.stat().st_mtime_ns for file in cache.rglob("reconstructions-*/*/*.npy")}
    main(arguments(tmp_path / "again", cache, refiner_file, "--trainer.max_epochs=1"))
    assert files and files == {file: file.stat().st_mtime_ns for file in cache.rglob("reconstructions-*/*/*.npy")}


def test_another_seed_makes_other_reconstructions_and_the_same_held_out_ones(tmp_path, refiner_file):
    first, second = (RefinementData(
        RefinementCases(1, 1, 16, seed=seed), Scenes(most_views=3), phantoms=2, cache=str(tmp_path / "cache"),
        initial=refiner_file, cube=Cube(32), window=(-1000, 600)) for seed in (0, 1))
    assert not np.array_equal(first.made[0], second.made[0])
    assert first.validation.made.folder == second.validation.made.folder


def test_an_epoch_says_how_many_reconstructions_are_still_to_be_made(tmp_path, refiner_file, capsys):
    data = RefinementData(
        RefinementCases(2, 1, 16), Scenes(most_views=3), phantoms=2, cache=str(tmp_path / "cache"),
        initial=refiner_file, cube=Cube(32), window=(-1000, 600))
    data.made.folder.mkdir(parents=True)
    for made, says in enumerate(("0 of 2 reconstructions are made", "1 of 2 reconstructions are made", "")):
        data.draws(made)
        assert capsys.readouterr().err.partition(",")[0] == says
        (data.made.folder / f"{made:05d}.npy").touch()


def test_held_out_reconstructions_are_those_of_their_own_volumes(tmp_path, refiner_file):
    def validated(phantoms: int) -> Path:
        data = RefinementData(
            RefinementCases(1, 1, 16), Scenes(most_views=3), phantoms=2, cache=str(tmp_path / "cache"),
            holdout=HoldOut(phantoms=phantoms), initial=refiner_file, cube=Cube(32), window=(-1000, 600))
        return data.validation.made.folder

    assert validated(1) == validated(1) != validated(2)


def test_with_a_network_a_reconstruction_is_learnt_from_at_both_calls(tmp_path, refiner_file):
    file = tmp_path / "fine.safetensors"
    save_stage(tiny_correction(), file, dtype=torch.float32)

    def data(network: str | None) -> RefinementData:
        return RefinementData(
            RefinementCases(1, 1, 16, network), Scenes(most_views=20), phantoms=4, cache=str(tmp_path / "cache"),
            holdout=HoldOut(phantoms=1), initial=refiner_file, cube=Cube(32), window=(-1000, 600))

    first, both = data(None), data(str(file))
    called_once, called_twice = (next(made for made in zip(first.made, both.made) if len(made[1]) == calls * INPUTS + 1)
                                 for calls in (1, 2))
    assert np.array_equal(*called_once)
    alone, made = called_twice
    assert np.array_equal(made[:INPUTS], alone[:INPUTS]) and np.array_equal(made[-1], alone[-1])
    before, after = made[:INPUTS], made[INPUTS:-1]
    assert len(after) == INPUTS and abs(after[0] - before[0]).max() > 0.01
    crops = {float(both.draws(0).item(made, np.random.default_rng(n))["scale"][0]) for n in range(8)}
    truth = made[-1, ::4, ::4, ::4].astype(np.float32)
    errors = {float(np.square(seen[0, ::4, ::4, ::4].astype(np.float32) - truth).mean()) for seen in (before, after)}
    assert sorted(crops) == pytest.approx(sorted(errors), rel=1e-4)
    assert np.array_equal(both.validation[0]["volume"][0], both.validation.made[0][INPUTS].astype(np.float32))


def test_finer_voxels_are_learnt_of_as_they_are_seen_after_the_coarser_ones(tmp_path, refiner_file):
    file, seen = tmp_path / "fine.safetensors", []
    save_stage(tiny_correction(), file, dtype=torch.float32)
    for name in (None, str(file)):
        data = RefinementData(  # of which the first scene has more than two views
            RefinementCases(1, 1, 16, name), Scenes(most_views=30), phantoms=1, cache=str(tmp_path / "cache"),
            holdout=HoldOut(phantoms=1), initial=refiner_file, cube=Cube(64), window=(-1000, 600))
        seen.append(np.array(data.made[0], np.float32))
    without, corrected = seen
    assert without.shape[1:] == corrected.shape[1:] == (64, 64, 64) and len(corrected) == 2 * INPUTS + 1
    assert np.array_equal(without[-1], corrected[-1])
    assert not np.allclose(without[0], corrected[0], atol=0.01)


def test_a_network_goes_on_on_its_own_voxels_or_half_as_long_ones(tmp_path):
    file = tmp_path / "fine.safetensors"
    save_stage(tiny_correction(), file, dtype=torch.float32)
    for voxels in (32, 64):
        learns = RefinementTraining(cube=Cube(voxels), window=(-1000, 600), initial=str(file))
        assert learns.prior.grid.same_as(Grid.cube(voxels))
        assert learns.prior.leave.weight.equal(tiny_correction().leave.weight)
    with pytest.raises(ValueError, match="another grid"):
        RefinementTraining(cube=Cube(128), window=(-1000, 600), initial=str(file))


@pytest.mark.parametrize("given, words", [
    (["--data.made.crop=48"], "data.made.crop is at most the 32 voxels"),
    (["--model.cube.voxels=16", "--data.made.crop=8"], "voxels finer than the refiner's"),
    (["--data.initial=prior.safetensors"], "give a refiner's file as data.initial"),
    (["--model.window=[-1000,1000]"], "model.window as its own"),
    (["--data.loading.simulation_voxels=64"], "data.loading.simulation_voxels is 64: leave it out"),
    (["--data.loading.population.share=0.5"], "data.loading.population.share is 0.5: set it to 0"),
    (["--data.loading.ct_fraction=0.7"], "data.loading.ct_fraction is 0.7: leave it out"),
    (["--data.made.reconstructions=0"], "data.made")])
def test_what_cannot_be_learnt_from_is_refused(tmp_path, cache, refiner_file, capsys, monkeypatch, given, words):
    monkeypatch.chdir(tmp_path)
    save_prior(tiny_prior(detail=True), "prior.safetensors")
    assert words in refusal(capsys, main, arguments(tmp_path / "run", cache, refiner_file, *given))


def test_of_more_cts_than_reconstructions_any_may_be_learnt_from_and_more_keep_those_that_were(tmp_path, refiner_file,
                                                                                               capsys):
    for n in range(6):
        save_ct(tmp_path / "cts" / f"{n}.nii.gz", thorax_hu())

    def made(count: int, seed: int = 0) -> RefinementData:
        return RefinementData(RefinementCases(count, 1, 16, seed=seed), cts=str(tmp_path / "cts"),
                              cache=str(tmp_path / "cache"), initial=refiner_file, cube=Cube(32), window=(-1000, 600))

    def shown(data: RefinementData) -> list[str]:
        return [ct.id for ct in data.made.volumes.datasets[0].cts]

    assert shown(made(6)) == shown(made(9)) == [*"012345"]
    assert len({tuple(shown(made(2, seed))) for seed in range(8)}) > 3
    assert shown(made(4))[:2] == shown(made(2)) and made(4).made.folder == made(2).made.folder != made(6).made.folder
    data = made(2)
    data.trainer = SimpleNamespace(state=SimpleNamespace(fn="fit"), limit_val_batches=1.0)
    data.prepare_data()
    assert "2 of 6 CTs are learnt from, chosen at random; data.made.reconstructions 6 would" in capsys.readouterr().err
