"""Whom a training holds out: who is meant, what its files say of it, and what is said where it is not so."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
import torch
from command_lines import checkpoint
from prior.tiny import tiny_prior, tiny_refiner

from phydict.cli.train import main
from phydict.datasets import CTSource
from phydict.datasets.itk_file import ENDINGS
from phydict.grid import Cube
from phydict.prior import save_prior, save_refiner
from phydict.prior.files import held_out_of
from phydict.runtime.files import machine
from phydict.training import PriorTraining
from phydict.training.crops import SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.reconstructions import RefinementCases, RefinementData
from phydict.training.rollouts import RollOutData, RollOutSettings
from phydict.training.settings import Crops, HoldOut

WINDOW = (-1000, 600)


def data(cts: Path, folder: Path, ids: list[str] | str | None = None, phantoms: int = 2) -> PriorData:
    return PriorData(str(cts), holdout=HoldOut(ids, phantoms=1), phantoms=phantoms, cache=str(folder / "cache"),
                     cube=Cube(16), window=WINDOW)


def in_trainer(made: PriorData, fn: str) -> PriorData:
    made.trainer = SimpleNamespace(state=SimpleNamespace(fn=fn), limit_val_batches=1.0)
    return made


def test_those_that_validate_are_a_list_a_word_or_the_lines_of_a_text_file(cts, tmp_path):
    (tmp_path / "held_out.txt").write_text("patient1\n")
    for ids in (["patient1"], "t1", str(tmp_path / "held_out.txt")):
        assert data(cts, tmp_path, ids).held_out == ["patient1"]
    with pytest.raises(FileNotFoundError, match="there is no file none.txt: give another data.holdout.ids"):
        data(cts, tmp_path, "none.txt")
    with pytest.raises(ValueError, match=r"\[0002\] has numbers among them: quote each"):
        HoldOut("[0002]")


@pytest.mark.parametrize("one, others", [("train_1_a_1", ("train_10_a_1", "train_11_a_1")), ("P1__a", ("P10__a",))])
def test_the_name_of_a_patient_holds_out_no_other_whose_name_begins_so(cts, tmp_path, one, others):
    (tmp_path / "cts").mkdir()
    for id in (one, *others):
        file = tmp_path / "cts" / f"{id.replace('__', '/')}.nii.gz"
        file.parent.mkdir(exist_ok=True)
        shutil.copy(cts / "patient0.nii.gz", file)
    patient = one.removesuffix("_a_1").removesuffix("__a")
    (tmp_path / "ids.txt").write_text(f"{patient}\n")
    for ids in ([patient], str(tmp_path / "ids.txt")):
        assert data(tmp_path / "cts", tmp_path, ids).held_out == [one]
    assert sorted(data(tmp_path / "cts", tmp_path, [patient[:-1]]).held_out) == sorted([one, *others])


@pytest.mark.parametrize("before, said, known", [
    (None, False, ["patient1"]), (["patient1", "patient7"], False, ["patient1"]), (["patient0"], True, []),
    ([], True, [])])
def test_a_file_tells_whom_it_never_learnt_from_and_others_are_warned_of(cts, tmp_path, monkeypatch, recwarn, before,
                                                                          said, known):
    file = str(tmp_path / "prior.safetensors")
    save_prior(tiny_prior(detail=True), file, {} if before is None else {"held_out": before})
    task = PriorTraining(cube=Cube(16), window=WINDOW, initial=file)
    monkeypatch.setattr(PriorTraining, "trainer", SimpleNamespace(
        datamodule=data(cts, tmp_path, ["patient1"]), global_step=2,
        strategy=SimpleNamespace(reduce=lambda value, **_: value)))
    task.setup("fit")
    told = f"patient1 was not among the held-out CTs of the training of {file}: unless it is new, it was trained on"
    assert [told in str(warning.message) for warning in recwarn] == [True] * said
    task.on_save_checkpoint(saved := {"state_dict": {}, "global_step": 2})
    assert saved["phydict"]["training"] == {"steps": 2, "samples": 0, "held_out": known}
    task.initial = task.held_out_before = None  # as where a training resumes without it
    task.on_load_checkpoint(saved)
    task.on_save_checkpoint(again := {"state_dict": {}})
    assert again["phydict"]["training"] == saved["phydict"]["training"]


def test_an_export_names_those_that_an_older_checkpoint_held_out_beside_cts_it_learnt_from(trained, tmp_path):
    content = checkpoint(trained)
    for name, held_out, trained_on, told in (("phantoms", [], {}, None), ("cts", ["patient1"], {}, ["patient1"]),
                                             ("untold", ["patient1"], {"trained": 0}, None)):
        content["PriorData"] = {"held_out": held_out} | trained_on
        torch.save(content, tmp_path / "last.ckpt")
        main(["export", f"--checkpoint={tmp_path / 'last.ckpt'}", f"--out={tmp_path / name}.safetensors"])
        assert held_out_of(tmp_path / f"{name}.safetensors") == told


def test_reconstructions_of_those_that_their_refiner_learnt_from_are_warned_of(cts, tmp_path):
    save_refiner(tiny_refiner(), file := str(tmp_path / "refiner.safetensors"), {"held_out": ["patient0"]})
    with pytest.warns(UserWarning, match="patient1 was not among the held-out CTs of the training of .*refiner"):
        RefinementData(RefinementCases(crop=16), cts=str(cts), holdout=HoldOut(["patient1"], phantoms=0), initial=file,
                       cache=str(tmp_path / "cache"), cube=Cube(32), window=WINDOW)


@pytest.mark.filterwarnings("ignore:patient1 was not among")
def test_a_training_resumes_with_what_the_same_network_makes(cts, tmp_path):
    files = [str(tmp_path / f"refiner_{n}.safetensors") for n in range(2)]
    for n, file in enumerate(files):
        save_refiner(tiny_refiner(), file, {"held_out": [f"patient{n}"]})
    settings = {"holdout": HoldOut(phantoms=0), "phantoms": 1, "cache": str(tmp_path / "cache"), "window": WINDOW}
    of_calls = [RollOutData(RollOutSettings(initial=file), cube=Cube(16), **settings) for file in files]
    of_crops = [RefinementData(RefinementCases(crop=16), initial=file, cube=Cube(32), **settings) for file in files]
    for (first, other), setting in ((of_calls, "model.initial"), (of_crops, "data.initial")):
        for made in (first, other):
            in_trainer(made, "fit")
        first.load_state_dict(first.state_dict())
        first.load_state_dict({name: value for name, value in first.state_dict().items() if name != "made_by"})  # older
        with pytest.raises(ValueError, match=f"{setting} is not the one that it was before: give that file again"):
            other.load_state_dict(first.state_dict())


def test_validation_on_those_that_were_trained_on_is_warned_of(cts, tmp_path):
    validated = in_trainer(data(cts, tmp_path, ["patient1"]), "validate")
    validated.load_state_dict(validated.state_dict())
    validated.load_state_dict({"held_out": [], "trained": 0})  # of a training on phantoms
    with pytest.warns(UserWarning, match="patient1 was not among the held-out CTs of the training: unless it is new"):
        validated.load_state_dict({"held_out": ["patient0"]})


@pytest.mark.parametrize("shape, refused", [((20, 20, 20, 1), ""), ((20, 20, 20, 2), "is 4D"),
                                            ((20, 20, 5), "has 5 slices")])
def test_a_ct_that_is_none_is_refused_before_the_first_step(tmp_path, shape, refused):
    (tmp_path / "cts").mkdir()
    for name, size in (("a", (20, 20, 20)), ("b", shape)):
        nibabel.save(nibabel.Nifti1Image(np.zeros(size, np.int16), np.eye(4)), tmp_path / "cts" / f"{name}.nii.gz")
    fitted = in_trainer(data(tmp_path / "cts", tmp_path), "fit")
    if not refused:
        return fitted.prepare_data()
    with pytest.raises(ValueError, match=f"b.nii.gz {refused}.* data.source.exclude"):
        fitted.prepare_data()


def test_what_a_killed_training_had_begun_to_prepare_is_removed(tmp_path):
    made = in_trainer(PriorData(phantoms=1, holdout=HoldOut(phantoms=0), cache=str(tmp_path), cube=Cube(16)), "fit")
    begun = [folder / f".{machine()}.{process}.part.1.npz" for folder in (tmp_path, tmp_path / "rollouts-1" / "2")
             for process in (99999999, os.getpid())]
    for file in begun:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    made.prepare_data()
    assert [file.exists() for file in begun] == [False, True] * 2


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_of_itk_that_is_no_ct_is_refused_before_the_first_step(tmp_path, ending):
    SimpleITK = pytest.importorskip("SimpleITK")
    (tmp_path / "cts").mkdir()
    for name, slices in (("a", 20), ("b", 5)):
        image = SimpleITK.GetImageFromArray(np.zeros((slices, 20, 20), np.int16))
        SimpleITK.WriteImage(image, str(tmp_path / "cts" / f"{name}{ending}"))
    with pytest.raises(ValueError, match=f"b{ending} has 5 slices .* data.source.exclude"):
        in_trainer(data(tmp_path / "cts", tmp_path), "fit").prepare_data()


def test_stages_that_learn_from_reconstructions_leave_the_same_cts_out_as_others(cts, tmp_path):
    save_refiner(tiny_refiner(), file := str(tmp_path / "refiner.safetensors"))
    (tmp_path / "excluded.txt").write_text("patient0\n")
    source, cache = CTSource(exclude=str(tmp_path / "excluded.txt")), str(tmp_path / "cache")
    replayed = RollOutData(RollOutSettings(initial=file, source=source), str(cts), phantoms=1, cache=cache,
                           cube=Cube(16), window=WINDOW)
    refined = RefinementData(RefinementCases(crop=16, source=source), cts=str(cts), cache=cache, initial=file,
                             cube=Cube(32), window=WINDOW)
    assert [[ct.id for ct in made.cts.cts] for made in (replayed, refined)] == [["patient1"]] * 2


def with_damaged(folder: Path) -> str:
    """A folder of three CTs, of which the second holds a voxel that is no number."""
    folder.mkdir()
    for name in ("a", "b", "c"):
        hu = np.full((12, 12, 12), -1000, np.float32)
        hu[3:9, 3:9] = 40
        if name == "b":
            hu[5, 5, 5] = np.nan
        nibabel.save(nibabel.Nifti1Image(hu, np.diag([10.0, 10.0, 10.0, 1.0])), folder / f"{name}.nii.gz")
    return str(folder)


@pytest.mark.parametrize("stage", ["base", "super_resolution"])
def test_a_damaged_ct_that_is_held_out_is_refused_before_the_first_step(tmp_path, stage):
    cts = with_damaged(tmp_path / "cts")

    def made(ids: list[str]) -> PriorData:
        if stage == "base":
            return in_trainer(data(cts, tmp_path, ids), "fit")
        return in_trainer(SuperResolutionData(Crops(8), cts, holdout=HoldOut(ids, phantoms=0), phantoms=1,
                                              cache=str(tmp_path / "cache"), cube=Cube(16)), "fit")

    made(["a"]).prepare_data()
    limited = made(["a", "b"])
    limited.trainer.limit_val_batches = 1
    limited.prepare_data()  # which never validates on it
    with pytest.raises(ValueError, match="b.nii.gz holds 1 NaN or infinite voxels"):
        made(["a", "b"]).prepare_data()


def test_a_training_resumes_without_cts_that_it_held_out_and_never_trains_on_one(tmp_path):
    cts = with_damaged(tmp_path / "cts")
    before = data(cts, tmp_path, ["a", "b"]).state_dict()
    Path(cts, "b.nii.gz").unlink()
    resumed = in_trainer(data(cts, tmp_path, ["a"]), "fit")
    with pytest.warns(UserWarning, match=r"of the 2 CTs that were held out, 1 are not among the data now .* is b\)"):
        resumed.load_state_dict(before)
    for ids, said in ((["c"], "a is not held out now"), (["a", "c"], "c is held out now")):
        with pytest.raises(ValueError, match=said):
            in_trainer(data(cts, tmp_path, ids), "fit").load_state_dict(before)


@pytest.mark.parametrize("ids", [["train_2"], "held_out.txt"], ids=["words", "the list"])
def test_no_other_scan_of_a_patient_who_was_held_out_is_trained_on_later(tmp_path, monkeypatch, ids):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cts").mkdir()
    for name in ("train_1_a_1", "train_2_a_1", "train_3_a_1"):
        (tmp_path / "cts" / f"{name}.nii.gz").touch()
    before = data(tmp_path / "cts", tmp_path, ["train_1", "train_2"]).state_dict()
    (tmp_path / "held_out.txt").write_text("\n".join(before["held_out"]))
    (tmp_path / "cts" / "train_1_a_1.nii.gz").rename(tmp_path / "cts" / "train_1_b_1.nii.gz")
    resumed = in_trainer(data(tmp_path / "cts", tmp_path, ids), "fit")
    if ids == "held_out.txt":
        assert resumed.held_out == ["train_1_b_1", "train_2_a_1"]
        assert [ct.id for ct in resumed.cts.cts] == ["train_3_a_1"]
        with pytest.warns(UserWarning, match=r"1 are not among the data now .* is train_1_a_1\)"):
            resumed.load_state_dict(before)
    else:
        with pytest.raises(ValueError, match="train_1_b_1 is not held out now"):
            resumed.load_state_dict(before)


def test_a_list_of_those_held_out_may_name_one_that_is_no_longer_there_and_words_may_not(cts, tmp_path):
    (tmp_path / "held_out.txt").write_text("patient7\npatient1\n")
    with pytest.warns(UserWarning, match="names 'patient7', but no CT has .* of the 2 lines of .*, 1 hold out"):
        assert data(cts, tmp_path, str(tmp_path / "held_out.txt")).held_out == ["patient1"]
    (tmp_path / "held_out.txt").write_text("patient7\n")
    for ids in (str(tmp_path / "held_out.txt"), ["patient7", "patient1"]):
        with pytest.raises(ValueError, match="names 'patient7', .*: correct or remove it"):
            data(cts, tmp_path, ids)
