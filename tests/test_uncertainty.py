"""How far a refiner's reconstruction may be off: intervals that hold their share, their training and their files."""

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import nibabel
import numpy as np
import pytest
import torch
from command_lines import checkpoint, refiner_arguments, refusal, resumed_as_uninterrupted
from prior.tiny import tiny_prior, tiny_refiner

from phydict.cli.infer import main as infer
from phydict.cli.train import main
from phydict.datasets import phantom_case
from phydict.grid import Cube, Grid
from phydict.inference import case_files
from phydict.methods import reconstruct
from phydict.posterior import Measurement, Unrolled
from phydict.posterior.refined import ON_FINER
from phydict.posterior.widening import contradiction_widening, widening_of
from phydict.prior import load_prior, save_prior, save_refiner
from phydict.prior.uncertainty import COVERAGES, LEVELS, TISSUES, Uncertainty, coverage_of, tissue_of
from phydict.training.refiner import RefinerTraining
from phydict.training.scenes import Scenes
from phydict.training.settings import CalibrationScenes
from phydict.training.uncertainty import UncertaintyTraining
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.boxes import interpolated

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "uncertainty.yaml"
GRID, BEAM = Grid.cube(16), ConeBeam.orbit(3, 1020, 740, (28, 28), 20.0)


def views() -> torch.Tensor:
    mu = torch.full((1, 1, *GRID.shape), 0.01)
    mu[..., 4:12, 4:12, 4:12] = 0.015
    return Projector(GRID, BEAM, full_detector=True)(mu)[0]


def arguments(folder: Path, cache: Path, initial: str, *more: str) -> list[str]:
    return refiner_arguments(CONFIG, folder, cache, initial, "--model.validation.scenes=2", *more)


@pytest.fixture(scope="module")
def refiner_file(tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("refiner") / "tiny.safetensors"
    save_refiner(tiny_refiner(uncertain=True), file, dtype=torch.float32)
    return str(file)


def test_calibrated_intervals_hold_their_share_in_each_tissue_and_coverage():
    """Of errors whose scale the network misjudges by a factor of its own for each of them."""
    network, draw = Uncertainty(4, (4, 8)), torch.Generator().manual_seed(0)
    tissues = torch.arange(len(TISSUES)).repeat_interleave(COVERAGES)
    coverages = torch.arange(COVERAGES).repeat(len(TISSUES))
    factors = torch.logspace(-1, 1, len(tissues))

    def ratios() -> torch.Tensor:
        return factors * torch.randn(20_000, len(tissues), generator=draw).abs()

    given = ratios()
    network.calibrate(given.flatten(), tissues.expand_as(given).flatten(), coverages.expand_as(given).flatten(),
                      torch.tensor([1.0] * 9 + [2.0] * 9 + [3.0, 50.0]))
    held = (ratios()[..., None] <= network.quantiles[tissues, coverages]).float().mean(0)
    torch.testing.assert_close(held, torch.tensor(LEVELS).expand_as(held), atol=0.015, rtol=0)
    assert 2 <= network.most_residual <= 3  # one scene of twenty says nothing of what is usual


def test_voxels_beyond_16_million_calibrate():
    network, ratios = Uncertainty(4, (4, 8)), torch.linspace(0, 1, 2**24 + 2)
    places = torch.zeros(len(ratios), dtype=torch.uint8)
    network.calibrate(ratios, places, places, torch.ones(1))
    torch.testing.assert_close(network.quantiles[0, 0], torch.tensor(LEVELS), atol=1e-6, rtol=0)


def test_few_voxels_take_the_quantiles_of_their_tissue_and_a_tissue_of_few_those_of_all():
    network = Uncertainty(4, (4, 8))
    ratios = torch.cat([torch.linspace(0, 1, 9000), torch.full((50,), 7.0), torch.full((60,), 9.0)])
    tissues = torch.cat([torch.zeros(9050), torch.ones(60)]).long()
    coverages = torch.cat([torch.zeros(9000), torch.ones(50), torch.ones(60)]).long()
    network.calibrate(ratios, tissues, coverages, torch.ones(1))
    torch.testing.assert_close(network.quantiles[0, 1], ratios[:9050].quantile(torch.tensor(LEVELS)))
    torch.testing.assert_close(network.quantiles[1, 1], ratios.quantile(torch.tensor(LEVELS)))
    assert torch.equal(network.quantiles[2], network.quantiles[1])


def test_an_uncalibrated_network_gives_the_intervals_of_its_own_distribution():
    network, z, evidence = Uncertainty(4, (4, 8)), torch.randn(1, 4, 8, 8, 8), torch.rand(1, 5, 8, 8, 8)
    with torch.no_grad():
        widths, scale = network.half_widths(z, evidence), network(z, evidence).exp()
    for n, level in enumerate(LEVELS):
        torch.testing.assert_close(1 - torch.exp(-widths[:, n:n + 1] / scale), torch.full_like(scale, level))


def test_voxels_are_sorted_by_mask_and_hu_and_by_the_views_that_see_them():
    z = torch.full((1, 4, 1, 1, 3), -0.99)
    z[0, 1, 0, 0, 0], z[0, 0, 0, 0, 1] = 0.8, 0.1
    assert tissue_of(z).flatten().tolist() == [0, 1, 2]
    assert tissue_of(z[:, :1]).flatten().tolist() == [2, 1, 2]
    evidence = torch.zeros(1, 5, 1, 1, 6)
    evidence[0, 1] = 0.2 * torch.log2(1 + torch.tensor([0.0, 1, 2, 8, 32, 200]))
    assert coverage_of(evidence).flatten().tolist() == [0, 1, 2, 3, 5, 5]


def test_a_reconstruction_has_nested_intervals_where_its_refiner_knows_them(tmp_path):
    refiner = tiny_refiner(uncertain=True)
    found = reconstruct(views(), BEAM, refiner, display=True)
    assert list(found.intervals) == list(LEVELS)
    widths = torch.stack(list(found.intervals.values()))
    assert (widths.diff(dim=0) > 0).all() and widths.shape[1:] == GRID.shape and (widths > 0).all()
    save_refiner(refiner, tmp_path / "tiny.safetensors", dtype=torch.float32)
    again = reconstruct(views(), BEAM, tmp_path / "tiny.safetensors", display=True)
    assert torch.equal(torch.stack(list(again.intervals.values())), widths)
    plain = reconstruct(views(), BEAM, tiny_refiner(), display=True)
    assert plain.intervals == {} and torch.equal(plain.volume, found.volume)
    assert found.projector_calls - plain.projector_calls == 2  # the evidence at the result


def test_on_finer_voxels_intervals_are_a_share_of_the_coarse_ones_and_of_what_the_refinement_changed():
    fine = Grid.cube(32)
    found = reconstruct(views(), BEAM, tiny_refiner(uncertain=True), display=True, grid=fine)
    change = (found.volume - interpolated(found.coarse.volume, GRID, fine, -1000.0)).abs()
    assert list(found.intervals) == list(LEVELS) and change.max() > 1
    for level, half_width in found.intervals.items():
        own, changed = ON_FINER[level]
        expected = own * interpolated(found.coarse.intervals[level], GRID, fine, 0.0) + changed * change
        torch.testing.assert_close(half_width, expected, atol=1e-3, rtol=1e-3)
    assert all((wide >= narrow).all() for narrow, wide in pairwise(found.intervals.values()))


def test_a_residual_larger_than_in_calibration_widens_the_intervals_and_a_far_larger_one_warns():
    refiner = tiny_refiner(uncertain=True)
    usual = reconstruct(views(), BEAM, refiner, display=True)
    refiner.uncertainty.most_residual.fill_(1e-3)
    with pytest.warns(UserWarning, match="usually at most 0.001 in the scenes") as said:
        wider = reconstruct(views(), BEAM, refiner, display=True)
    residual = float(str(said[0].message).split("X-rays is ")[1].split(" times")[0])
    assert usual.interval_widening == 1
    assert wider.interval_widening == pytest.approx((residual / 1e-3) ** 0.25, rel=0.01)
    torch.testing.assert_close(wider.intervals[0.9], wider.interval_widening * usual.intervals[0.9])
    refiner.uncertainty.most_residual.fill_(residual / 4)
    assert reconstruct(views(), BEAM, refiner, display=True).interval_widening == pytest.approx(4**0.25, rel=0.01)


def test_intervals_widen_the_more_the_views_contradict_each_other_and_not_where_they_agree():
    m = Measurement(Projector(GRID, BEAM, full_detector=True), views(), HUWindow(), noise=0.01)
    assert contradiction_widening(m) == 1
    factors = []
    for counted in ((0, 0, 0), (0, 0.1, 0), (0, 1, 0), (0, 1, 0.1), (1, 1, 0.1)):
        m.model_variance = torch.tensor(counted)[:, None, None]
        factors.append(contradiction_widening(m))
    assert factors[0] == 1 and factors == sorted(set(factors))
    m.model_variance = m.model_variance.flip(0)
    assert contradiction_widening(m) == pytest.approx(factors[-1])


def test_contradicted_views_widen_the_intervals_and_the_warning_says_how_much():
    refiner = tiny_refiner(uncertain=True)
    with pytest.warns(UserWarning, match="no volume explains .* intervals are") as said:
        found = reconstruct(views(), BEAM, refiner, Unrolled(contradiction=0.0), display=True)
    words = [str(w.message) for w in said if "no volume explains" in str(w.message)]
    assert found.interval_widening > 1 and f"{found.interval_widening:.1f} times as wide" in words[0]


def test_no_interval_is_wider_than_the_window_in_which_volume_and_truth_lie():
    refiner = tiny_refiner(uncertain=True)
    refiner.uncertainty.quantiles.mul_(1e6)
    found = reconstruct(views(), BEAM, refiner, display=True)
    assert all(float(half_width.max()) == 2 * refiner.window.half_width for half_width in found.intervals.values())


def test_the_residual_of_calibration_is_the_one_by_which_intervals_widen(refiner_file, monkeypatch):
    """Where views contradict each other too, of which a part counts as noise."""
    task = UncertaintyTraining(cube=Cube(16), window=(-1000, 600), scenes=Scenes(most_views=4),
                               validation=CalibrationScenes(scenes=1), initial=refiner_file)
    ends, whole = [], task._reconstruct

    def contradicting(*given):
        ends.extend(whole(*given))
        ends[-1].model_variance = 8 * ends[-1].noise_variance.mean((1, 2), keepdim=True)
        return ends

    monkeypatch.setattr(task, "_reconstruct", contradicting)
    monkeypatch.setattr(task, "validation_number", lambda index: index)
    for name in ("log", "log_case"):
        monkeypatch.setattr(task, name, Mock())
    task.validation_step({"volume": phantom_case(1, GRID, HUWindow(-1000, 600))["volume"][None]}, 0)
    (z, _, measurement), residual = ends, float(task.held_out[0][3])
    usual, wider = (widening_of(measurement, measurement.project(z[:, :1]), share * residual) for share in (1.001, 0.9))
    assert wider == pytest.approx(usual * 0.9**-0.25)


def test_subtracted_scatter_leaves_the_intervals_as_wide_as_calibrated():
    found = reconstruct(views(), BEAM, tiny_refiner(uncertain=True))
    assert found.scatter > 0 and found.interval_widening == 1


@pytest.mark.filterwarnings("ignore:no volume explains")
def test_predict_writes_the_interval_beside_the_volume(tmp_path, refiner_file, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "xrays"
    folder.mkdir()
    BEAM.save(folder / "geometry.yaml")
    for n, view in enumerate(views()):
        nibabel.save(nibabel.Nifti1Image(view.numpy(), torch.eye(4).numpy()), folder / f"view_{n}.nii.gz")
    panel = Mock(wraps=case_files.panel)
    monkeypatch.setattr(case_files, "panel", panel)
    infer(["predict", f"--data.xrays={folder}", f"--model.prior={refiner_file}", "--model.out=out",
           "--trainer.accelerator=cpu"])
    [case] = Path("out/phydict_learned").glob("*/")
    record = json.loads((case / "reconstruction.json").read_text())
    interval, volume = (nibabel.load(case / name) for name in ("interval_90.nii.gz", "volume.nii.gz"))
    assert (interval.affine == volume.affine).all() and (interval.get_fdata() > 0).all()
    assert (widening := record["interval_widening"]) >= 1
    assert (f"intervals {widening:.1f} times as wide as calibrated" in capsys.readouterr().err) == (widening >= 1.05)
    assert 0 < record["interval_90_hu"] <= interval.get_fdata().max()
    shown = panel.call_args.kwargs
    assert shown["deviation_label"] == "half of the 90% interval"
    np.testing.assert_allclose(shown["deviation_hu"], interval.get_fdata(), atol=1)


def test_a_resumed_run_is_the_uninterrupted_one_and_leaves_the_refiner_as_it_was(tmp_path, cache, refiner_file):
    last = resumed_as_uninterrupted(main, lambda run, *more: arguments(run, cache, refiner_file, *more), tmp_path)
    main(["export", "--checkpoint", str(last), "--out", str(tmp_path / "refiner.safetensors")])
    trained, before = load_prior(tmp_path / "refiner.safetensors").state_dict(), load_prior(refiner_file).state_dict()
    moved = {name for name in before if not torch.equal(before[name].half(), trained[name].half())}
    assert moved and all(name.startswith("uncertainty.") for name in moved) and "uncertainty.quantiles" in moved


@pytest.mark.slow
def test_two_processes_calibrate_on_the_held_out_cases_that_one_would(tmp_path, cache, refiner_file):
    ddp = f"--config={CONFIG.with_name('ddp.yaml')}"
    for run, more in (("one", ["--trainer.devices=1"]), ("two", [ddp, "--trainer.devices=2"])):
        args = arguments(tmp_path / run, cache, refiner_file, *more, "--data.holdout.phantoms=3",
                         f"--data.loading.batch_size={1 if run == 'two' else 2}", "--trainer.max_epochs=1")
        done = subprocess.run([sys.executable, str(CONFIG.parents[2] / "train.py"), *args], capture_output=True,
                              text=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"})
        assert done.returncode == 0, done.stderr[-2000:]
    one, two = (checkpoint(tmp_path / run)["state_dict"] for run in ("one", "two"))
    for name in ("prior.uncertainty.quantiles", "prior.uncertainty.most_residual"):
        torch.testing.assert_close(two[name], one[name], rtol=1e-3, atol=0)


def test_a_prior_in_place_of_a_refiner_is_refused(tmp_path, cache, capsys):
    save_prior(tiny_prior(detail=True), tmp_path / "prior.safetensors")
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, str(tmp_path / "prior.safetensors")))
    assert "uncertainty is learnt of a refiner" in said and "model.initial" in said


def test_weights_that_validation_calibrates_are_not_averaged(tmp_path, cache, refiner_file, capsys):
    said = refusal(capsys, main, arguments(tmp_path, cache, refiner_file, "--trainer.max_epochs=1",
                                           "--trainer.callbacks=lightning.pytorch.callbacks.EMAWeightAveraging"))
    assert "train without EMAWeightAveraging (trainer.callbacks: null)" in said
    assert not (tmp_path / "last.ckpt").exists()


def test_a_refiner_that_is_trained_on_loses_what_was_known_of_its_errors(refiner_file):
    assert load_prior(refiner_file).uncertainty is not None
    assert RefinerTraining(cube=Cube(16), window=(-1000, 600), initial=refiner_file).prior.uncertainty is None
