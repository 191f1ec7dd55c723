"""Training a refiner on stored calls: they are those of its reconstructions, and a resumed run repeats itself."""

from pathlib import Path

import numpy as np
import pytest
import torch
from command_lines import refiner_arguments, refusal, resumed_as_uninterrupted
from ct_files import save_ct, thorax_hu
from prior.tiny import tiny_prior

from phydict.cli.train import main
from phydict.datasets import CTSource
from phydict.grid import Cube
from phydict.prior import Refiner, load_prior, save_prior
from phydict.training.refiner import RefinerTraining
from phydict.training.rollouts import ReplayTraining, RollOutData, RollOuts, RollOutSettings
from phydict.training.scenes import Scenes
from phydict.training.settings import Loading

CONFIG = Path(__file__).parents[1] / "configs" / "prior" / "replay.yaml"
SETTINGS = {"cube": Cube(16), "window": (-1000, 600)}


def rollouts(refiner_file: str, cache: Path, count: int = 1, **more) -> RollOutData:
    settings = RollOutSettings(count, Scenes(most_views=4), refiner_file)
    return RollOutData(settings, phantoms=2, cache=str(cache), **SETTINGS, **more)


def test_single_calls_are_learnt_from_as_a_whole_reconstruction_is(refiner_file, cache):
    data = rollouts(refiner_file, cache)
    whole = RefinerTraining(scenes=data.rollouts.settings.scenes, initial=refiner_file, **SETTINGS)
    single = ReplayTraining(initial=refiner_file, **SETTINGS)
    draws, found = data.draws(0), {}
    for i in range(40):
        batch = data.collate([draws[i]])
        found[int(batch["call"])] = single.batch_loss(batch)
    live = whole._case_loss(data._case(0), np.random.default_rng((0, 0)))
    torch.testing.assert_close(torch.stack([found[n] for n in range(whole.calls)]).mean(), live, rtol=2e-3, atol=2e-3)


def test_an_epoch_says_how_many_roll_outs_are_still_to_be_made(tmp_path, refiner_file, capsys):
    data, said = rollouts(refiner_file, tmp_path, count=2), []
    for epoch in range(3):
        data.draws(epoch)
        said.append(capsys.readouterr().err)
        data.rollouts[min(epoch, 1)]
    assert [text.partition(",")[0] for text in said] == ["0 of 2 roll-outs are made", "1 of 2 roll-outs are made", ""]
    assert said[0].endswith(f"in {data.rollouts.folder}\n")


def test_calls_of_finer_volumes_and_masks_that_are_not_known_are_kept_as_such(refiner_file, cache, monkeypatch):
    data = rollouts(refiner_file, cache, loading=Loading(simulation_voxels=32))
    case, kinds = data._case(0), load_prior(refiner_file).state_channels - 1
    assert case["fine"].shape[-1] == 32
    case["has_masks"] = torch.tensor([[True, False, False]])
    monkeypatch.setattr(data.rollouts, "drawn", lambda n: case)
    item = data.draws(0)[0]
    assert item["masks"].isnan().flatten(1).all(1).tolist() == [False, True, True][:kinds]
    torch.testing.assert_close(item["volume"], case["volume"][0], rtol=1e-3, atol=1e-3)
    assert ReplayTraining(initial=refiner_file, **SETTINGS).batch_loss(data.collate([item])).isfinite()


@pytest.mark.slow
def test_a_resumed_run_is_the_uninterrupted_one_and_makes_each_roll_out_once(tmp_path, refiner_file, monkeypatch):
    cache, made, make = tmp_path / "cache", [], RollOuts._made
    monkeypatch.setattr(RollOuts, "_made", lambda self, n: (made.append(n), make(self, n))[1])

    def fit(run: Path, *more: str) -> list[str]:
        args = refiner_arguments(CONFIG, run, cache, refiner_file, "--trainer.limit_val_batches=0",
                                 "--data.rollouts.count=2", *more)
        return [arg.replace("--model.scenes", "--data.rollouts.scenes") for arg in args]

    last = resumed_as_uninterrupted(main, fit, tmp_path)
    main(["export", "--checkpoint", str(last), "--out", str(tmp_path / "refiner.safetensors")])
    learnt, begun = load_prior(tmp_path / "refiner.safetensors"), load_prior(refiner_file)
    assert isinstance(learnt, Refiner) and not torch.equal(learnt.entrance.weight, begun.entrance.weight)
    [folder] = cache.glob("**/rollouts-*")
    assert made and sorted(made) == sorted(int(file.stem) for file in folder.iterdir())


def test_roll_outs_are_kept_for_more_of_them_and_not_for_other_cases(tmp_path, refiner_file, monkeypatch):
    def folder(count: int = 1) -> Path:
        return rollouts(refiner_file, tmp_path / "cache", count, cts=str(tmp_path / "cts")).rollouts.folder

    file = tmp_path / "cts" / "a.nii.gz"
    save_ct(file, thorax_hu())
    first = folder()
    assert folder(count=3) == first
    save_ct(file, thorax_hu() + 10)
    assert (second := folder()) != first
    monkeypatch.setattr("phydict.datasets.phantoms.cached.PHANTOM_VERSION", 0)
    assert (third := folder()) not in (first, second)
    monkeypatch.setattr("phydict.training.data.DRAW_VERSION", 0)
    assert folder() not in (first, second, third)


def test_a_prior_that_is_no_refiner_has_no_roll_outs(tmp_path, cache, capsys):
    save_prior(tiny_prior(detail=True), tmp_path / "prior.safetensors", dtype=torch.float32)
    args = refiner_arguments(CONFIG, tmp_path / "run", cache, str(tmp_path / "prior.safetensors"))
    args = [arg for arg in args if not arg.startswith("--model.scenes")]
    assert "give a refiner's file as model.initial" in refusal(capsys, main, args)


def test_stored_calls_are_learnt_from_at_the_times_at_which_they_were_made(tmp_path, refiner_file, cache, capsys):
    args = refiner_arguments(CONFIG, tmp_path / "run", cache, refiner_file, "--data.rollouts.count=1",
                             "--model.method.times=[0.5,0.2]", "--model.method.x0_stds=[0.3,0.2,0.1]",
                             "--trainer.max_epochs=1")
    args = [arg.replace("--model.scenes", "--data.rollouts.scenes") for arg in args]
    assert "leave model.method out" in refusal(capsys, main, args)


def test_other_reports_have_other_roll_outs_since_they_decide_what_may_be_mirrored(tmp_path, refiner_file):
    save_ct(tmp_path / "cts" / "a.nii.gz", thorax_hu())

    def folder(report: str) -> Path:
        table = tmp_path / "reports.csv"
        table.write_text(f"VolumeName,Findings_EN,Impressions_EN\na,{report},\n")
        settings = RollOutSettings(1, Scenes(most_views=4), refiner_file, CTSource(str(table)))
        return RollOutData(settings, str(tmp_path / "cts"), phantoms=2, cache=str(tmp_path / "cache"),
                           **SETTINGS).rollouts.folder

    assert folder("Nodule.") == folder("Nodule.") != folder("Nodule at the left.")
