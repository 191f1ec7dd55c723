"""How far a reconstruction on finer voxels may be off: intervals that hold their share, their training, their file."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from command_lines import refinement_arguments, refusal, resumed_as_uninterrupted
from fitting import fit_to_grid
from prior.tiny import tiny_correction, tiny_refiner
from torch.nn.functional import pad

from phydict.cli.train import main
from phydict.grid import Cube, Grid
from phydict.methods import reconstructor
from phydict.posterior import Refined, Unrolled
from phydict.posterior.refined import ON_FINER
from phydict.prior import load_correction, local_unet, save_refiner, save_stage
from phydict.prior.correction import CorrectionNetwork
from phydict.prior.finer_uncertainty import INPUT_CHANNELS, FinerUncertainty, tissue_of_seen
from phydict.prior.uncertainty import LEVELS, TISSUES
from phydict.training.finer_uncertainty import FinerUncertaintyTraining
from phydict.training.refinement import RefinementTraining
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector
from phydict.xray.boxes import interpolated

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "finer_uncertainty.yaml"
FINE, WINDOW = Grid.cube(32), HUWindow(-1000, 600)
BEAM = ConeBeam.orbit(3, 1020, 740, (56, 56), 10.0)


def seen(*shape: int) -> torch.Tensor:
    draw = torch.Generator().manual_seed(0)
    z, before, width, lung = torch.rand(4, 1, 1, *shape, generator=draw)
    return torch.cat([2 * z - 1, 2 * before - 1, 0.3 * width, lung], 1)


def reconstructed(network: CorrectionNetwork, target: Grid = FINE):
    xrays = Projector(target, BEAM, full_detector=True)(0.02 * torch.ones(1, 1, *target.shape))[0]
    base = reconstructor(Unrolled((0.2,), (0.5, 0.3)), tiny_refiner(uncertain=True))
    ready = Refined(base, target, networks=(network,))
    return ready.reconstruct(*fit_to_grid(ready, target, xrays, BEAM))


def test_calibrated_intervals_hold_their_share_in_each_tissue():
    network, draw = FinerUncertainty((4, 8)), torch.Generator().manual_seed(0)
    tissues, factors = torch.arange(len(TISSUES)), torch.tensor([0.2, 1.0, 7.0])

    def ratios() -> torch.Tensor:
        return factors * torch.randn(20_000, len(tissues), generator=draw).abs()

    given = ratios()
    network.calibrate(given.flatten(), tissues.expand_as(given).flatten())
    held = (ratios()[..., None] <= network.quantiles[tissues]).float().mean(0)
    torch.testing.assert_close(held, torch.tensor(LEVELS).expand_as(held), atol=0.015, rtol=0)


def test_an_uncalibrated_network_gives_the_intervals_of_its_own_distribution():
    network = FinerUncertainty((4, 8))
    with torch.no_grad():
        widths, scale = network.half_widths(seen(8, 8, 8)), network(seen(8, 8, 8)).exp()
    for n, level in enumerate(LEVELS):
        torch.testing.assert_close(1 - torch.exp(-widths[:, n:n + 1] / scale), torch.full_like(scale, level))


def test_voxels_are_sorted_by_the_share_of_lung_and_hu():
    given = torch.zeros(1, INPUT_CHANNELS, 1, 1, 3)
    given[0, 0, 0, 0], given[0, 3, 0, 0] = torch.tensor([-0.99, 0.1, -0.99]), torch.tensor([0.8, 0.2, 0.2])
    assert [TISSUES[tissue] for tissue in tissue_of_seen(given).flatten()] == ["lung", "body", "air"]


def test_odd_sizes_are_those_of_their_voxels_repeated_at_the_end():
    network, given = FinerUncertainty((4, 8)), seen(9, 8, 7)
    whole = network(pad(given, (0, 1, 0, 0, 0, 1), mode="replicate"))
    torch.testing.assert_close(network(given), whole[..., :9, :, :7])


def test_slab_by_slab_it_is_that_of_the_whole(monkeypatch):
    network, given = FinerUncertainty((4, 8, 12)), seen(32, 24, 20)
    whole = network(given)
    for planes in (2, 6, 10):
        monkeypatch.setattr(local_unet, "SLAB_VOXELS", planes * 24 * 20)
        torch.testing.assert_close(network(given), whole, atol=1e-6, rtol=1e-5)


def test_intervals_on_finer_voxels_are_the_networks_where_it_learnt_on_these_and_nested():
    network, found = tiny_correction(uncertain=True), reconstructed(tiny_correction(uncertain=True))
    coarse, window = found.coarse, WINDOW
    width, lung = (interpolated(of_coarse, coarse.grid, FINE, 0.0)
                   for of_coarse in (coarse.intervals[0.9] / window.half_width, coarse.masks[0]))
    start = interpolated(coarse.volume, coarse.grid, FINE, -1000.0)
    given = torch.stack([window.to_range(found.volume), window.to_range(start), width, lung])[None]
    for level, expected in zip(LEVELS, window.half_width * network.uncertainty.half_widths(given)[0]):
        torch.testing.assert_close(found.intervals[level], expected, atol=1.0, rtol=0.02)  # HU; "auto" may be bfloat16
    assert all((wide > narrow).all() for narrow, wide in pairwise(found.intervals.values()))
    assert found.volume.equal(reconstructed(tiny_correction()).volume)


def test_on_voxels_half_as_long_they_are_interpolated_and_on_others_made_of_the_coarse_ones():
    finest = Grid.cube(64)
    found = reconstructed(tiny_correction(uncertain=True), finest)
    without = reconstructed(tiny_correction(), finest)
    assert found.volume.equal(without.volume) and list(found.intervals) == list(LEVELS)
    own, changed = ON_FINER[0.9]
    change = (without.volume - interpolated(without.coarse.volume, without.coarse.grid, finest, -1000.0)).abs()
    expected = own * interpolated(without.coarse.intervals[0.9], without.coarse.grid, finest, 0.0) + changed * change
    torch.testing.assert_close(without.intervals[0.9], expected, atol=1e-2, rtol=1e-3)
    width = found.intervals[0.9]
    assert not width.allclose(expected, rtol=0.1)
    again = interpolated(torch.nn.functional.avg_pool3d(width[None], 2)[0], FINE, finest, 0.0)
    assert (again - width).abs().median() < 0.1 * width.median()
    others = reconstructed(tiny_correction(Grid.cube(64), uncertain=True))
    assert others.intervals[0.9].equal(reconstructed(tiny_correction(Grid.cube(64))).intervals[0.9])


def test_a_file_holds_what_is_known_and_one_without_it_is_read_as_before(tmp_path):
    for uncertain in (True, False):
        save_stage(tiny_correction(uncertain=uncertain), tmp_path / "fine.safetensors", dtype=torch.float32)
        loaded = load_correction(tmp_path / "fine.safetensors")
        widths = loaded.half_widths(FINE, seen(8, 8, 8))
        assert (widths is not None) == uncertain
        if uncertain:
            assert widths.equal(tiny_correction(uncertain=True).half_widths(FINE, seen(8, 8, 8)))
    assert tiny_correction(uncertain=True).half_widths(Grid.cube(64), seen(8, 8, 8)) is None


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[str, str, str]:
    """A refiner with intervals, one without, and a correction."""
    folder = tmp_path_factory.mktemp("networks")
    refiner, plain, fine = (folder / f"{name}.safetensors" for name in ("refiner", "plain", "fine"))
    save_refiner(tiny_refiner(uncertain=True), refiner, dtype=torch.float32)
    save_refiner(tiny_refiner(), plain, dtype=torch.float32)
    save_stage(tiny_correction(), fine, dtype=torch.float32)
    return str(refiner), str(plain), str(fine)


def arguments(folder: Path, cache: Path, refiner: str, fine: str, *more: str) -> list[str]:
    return refinement_arguments(CONFIG, folder, cache, refiner, "--model.network.channels=[4,8]",
                                f"--data.made.network={fine}", f"--model.initial={fine}", *more)


def test_a_resumed_run_is_the_uninterrupted_one_and_leaves_the_correction_as_it_was(tmp_path, cache, files):
    refiner, _, fine = files
    last = resumed_as_uninterrupted(main, lambda run, *more: arguments(run, cache, refiner, fine, *more), tmp_path)
    main(["export", "--checkpoint", str(last), "--out", str(tmp_path / "knows.safetensors")])
    trained, before = (load_correction(file).state_dict() for file in (tmp_path / "knows.safetensors", fine))
    assert all(torch.equal(before[name].half(), trained[name].half()) for name in before)
    assert all(name.startswith("uncertainty.") for name in trained.keys() - before.keys())
    assert not torch.equal(trained["uncertainty.quantiles"], FinerUncertainty((4, 8)).quantiles.half().float())


def test_intervals_are_those_of_the_network_whose_results_are_stored(tmp_path, cache, files, capsys):
    refiner, _, fine = files
    save_stage(tiny_correction(), other := tmp_path / "other.safetensors", dtype=torch.float16)
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, refiner, fine, f"--model.initial={other}",
                                           "--trainer.max_epochs=1"))
    assert "give one file as model.initial and data.made.network" in said


def test_intervals_are_not_calibrated_on_nothing(tmp_path, cache, files, capsys):
    refiner, _, fine = files
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, refiner, fine, "--data.holdout.phantoms=0",
                                           "--trainer.max_epochs=1"))
    assert "nothing is held out" in said


def test_a_training_of_intervals_and_one_of_the_correction_are_not_resumed_as_each_other(files):
    settings = {"cube": Cube(32), "window": (-1000, 600), "initial": files[2]}
    for task, other in ((FinerUncertaintyTraining(FinerUncertainty((4, 8)), **settings), tiny_correction()),
                        (RefinementTraining(**settings), tiny_correction(uncertain=True))):
        with pytest.raises(ValueError, match="differ in 'uncertainty': give the settings"):
            task.on_load_checkpoint({"phydict": other.describe() | {"training": {"samples": 8}}})
        task.on_load_checkpoint({"phydict": task.prior.describe() | {"training": {"samples": 8}}})
        assert task.samples == 8


def test_a_batch_is_one_loss_however_many_processes_share_it(files):
    task = FinerUncertaintyTraining(FinerUncertainty((4, 8)), Cube(32), (-1000, 600), initial=files[2])
    crops = torch.cat([seen(8, 8, 8), 0.5 * seen(8, 8, 8)[:, :1]], 1).repeat(2, 1, 1, 1, 1)
    crops[0, 0], crops[0, 3] = -0.99, 0.0  # air
    halves = [task.batch_loss({"volume": crops[rank::2]}, (0,), rank, 2) for rank in range(2)]
    torch.testing.assert_close(sum(halves) / 2, task.batch_loss({"volume": crops}))


def test_steps_on_one_crop_bring_the_scale_to_the_errors(files):
    torch.manual_seed(0)
    task = FinerUncertaintyTraining(FinerUncertainty((4, 8), 8), Cube(32), (-1000, 600), initial=files[2])
    given = seen(16, 16, 16)
    given[:, 2] = 0.1
    error = torch.where(given[:, :1] > 0, 0.2, 0.01)
    batch = {"volume": torch.cat([given, given[:, :1] + error], 1)}
    weights = [w for w in task.parameters() if w.requires_grad]
    optimizer = torch.optim.Adam(weights, 2e-3)
    for _ in range(150):
        optimizer.zero_grad()
        task.batch_loss(batch).backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
    scale = task.prior.uncertainty(given).exp()
    assert scale[error > 0.1].median() > 3 * scale[error < 0.1].median()


@pytest.mark.parametrize("refiner, more, words", [
    (1, [], "made of a refiner's own, but"), (0, ["--model.window=[-1000,1000]"], "has another grid or HU window")])
def test_what_cannot_be_learnt_from_is_refused(tmp_path, cache, files, capsys, refiner, more, words):
    assert words in refusal(capsys, main, arguments(tmp_path / "run", cache, files[refiner], files[2], *more))


def test_a_correction_that_is_trained_on_loses_what_was_known_of_its_errors(tmp_path):
    save_stage(tiny_correction(uncertain=True), tmp_path / "knows.safetensors", dtype=torch.float32)
    trained = RefinementTraining(cube=Cube(32), window=(-1000, 600), initial=str(tmp_path / "knows.safetensors"))
    assert trained.prior.uncertainty is None and all(w.requires_grad for w in trained.parameters())


def test_intervals_are_exported_with_those_weights_alone_that_they_are_of(tmp_path, files, monkeypatch, capsys):
    task = FinerUncertaintyTraining(FinerUncertainty((4, 8)), Cube(32), (-1000, 600), initial=files[2])
    trainer = SimpleNamespace(datamodule=None, strategy=SimpleNamespace(reduce=lambda value, **_: value))
    monkeypatch.setattr(FinerUncertaintyTraining, "trainer", trainer)
    monkeypatch.setattr(FinerUncertaintyTraining, "of_all_processes", lambda self, given: given[0])
    export = ["export", f"--checkpoint={tmp_path / 'c.ckpt'}", f"--out={tmp_path / 'knows.safetensors'}",
              "--overwrite=true"]

    def save(step: int) -> dict:
        trainer.global_step = step
        task.on_save_checkpoint(content := {"state_dict": task.state_dict(), "global_step": step})
        torch.save(content, tmp_path / "c.ckpt")
        return content

    never = save(2)
    assert "were not calibrated, but its weights are those after step 2" in refusal(capsys, main, export)
    task.held_out = [(torch.rand(100), torch.zeros(100))]
    task.on_validation_epoch_end()
    save(2)
    main(export)
    save(3)
    assert "were calibrated after step 2, but its weights are those after step 3" in refusal(capsys, main, export)
    task.on_load_checkpoint(never)
    save(2)
    assert "were not calibrated" in refusal(capsys, main, export)
    torch.save({name: part for name, part in never.items() if name != "calibrated_at"}, tmp_path / "c.ckpt")
    main(export)  # one from before it was kept


def test_a_stage_that_validation_calibrates_is_not_trained_without_validation(tmp_path, cache, files, capsys):
    refiner, _, fine = files
    said = refusal(capsys, main, arguments(tmp_path / "run", cache, refiner, fine, "--trainer.limit_val_batches=0",
                                           "--trainer.max_epochs=1"))
    assert "validation calibrates the intervals, but trainer.limit_val_batches is 0: leave it out" in said
