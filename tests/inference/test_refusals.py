"""Options that cannot be meant: one sentence each, and nothing is written."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from command_lines import refusal
from prior.medsyn_files import entries, super_resolution_unet, text_unet, write

from inference.runs import BEAM, LAUGHS, ORBIT, contents, phantoms, record, sirt, with_prior
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.grid import Grid
from phydict.inference.data import ReconstructionData
from phydict.methods import reconstructor
from phydict.posterior import PriorOnly
from phydict.units import HUWindow
from phydict.xray import Polychromatic, Projector


@pytest.mark.parametrize("place, name, how", [
    (".", "cases", "is the input"), (".", "linked", "is the input"), ("cases", "anna", "lies inside"),
    ("cases", "sirt", "lies inside"), ("cases/anna", "sirt", "lies inside"), ("..", "{parent}", "holds"),
    ("linked", "anna", "lies inside")])
def test_an_output_that_is_holds_or_lies_inside_the_input_is_refused(measured, tmp_path, capsys, place, name, how):
    shutil.copytree(measured, tmp_path / "cases")
    (tmp_path / "linked").symlink_to(tmp_path / "cases")
    before = contents(tmp_path)
    args = sirt("predict", tmp_path / place, f"--data.xrays={tmp_path / 'cases'}", "--model.overwrite=true",
                f"--model.name={name.format(parent=tmp_path.name)}")
    said = refusal(capsys, main, args)
    assert how in said and "give another model.out" in said and contents(tmp_path) == before


def test_a_list_of_cases_must_fit_the_folder(cts, tmp_path, capsys):
    (tmp_path / "only.txt").write_text("b\nnobody\n")
    args = sirt("test", tmp_path, f"--data.cts={cts}", *ORBIT, f"--data.only={tmp_path / 'only.txt'}")
    said = refusal(capsys, main, args)
    assert f"only ({tmp_path / 'only.txt'}) names nobody, which cts ({cts}) does not hold" in said
    (tmp_path / "spec.yaml").write_text(f"{{out: {tmp_path / 'out'}, base: {{method: sirt}}}}")
    args = ["ablate", "-c", str(tmp_path / "spec.yaml"), "--cts", str(cts), "--only"]
    for file, words in (("only.txt", "names nobody, which cts"), ("none.txt", "give another only, a text file")):
        said = refusal(capsys, main, [*args, str(tmp_path / file)])
        assert words in said and "data." not in said


def test_other_xrays_into_a_finished_folder_are_refused(scored, capsys):
    for change in ("--data.orbit.views=4", "--data.simulation_voxels=128", "--data.simulator.noise=0.1"):
        assert "other settings" in refusal(capsys, main, phantoms(scored.parent, 2, change))


@pytest.mark.parametrize("change, words", [
    (["--model.grid=0"], "a whole number of voxels"), (["--model.grid=100000"], "GiB of memory"),
    (["--model.seed=-1"], "a seed is a whole number"), ([f"--model.seed={2**70}"], "a seed is a whole number"),
    (["--model.method.init_args.mu_water=0"], "mu_water"), (["--model.method.init_args.mu_water=-1"], "mu_water"),
    (["--model.ou={tmp}/out"], "model.ou"), (["--data.xray={tmp}"], "data.xray"), (["--data.xray", "3"], "data.xray"),
    (["--config={tmp}/twice.yaml"], "twice.yaml: `model.seed` is given twice"),
    (["--config={tmp}/laughs.yaml"], "by aliases"), (["--config={tmp}/latin.yaml"], "latin.yaml is not UTF-8"),
    (["--config={tmp}/deep.yaml"], "nested more than 32 levels"),
], ids=lambda value: value[0].strip("-") if isinstance(value, list) else "")
def test_an_option_that_cannot_be_meant_is_one_sentence(change, words, measured, tmp_path, capsys):
    for name, text in (("twice", "model: {seed: 1, seed: 2}"), ("deep", "[" * 20_000),
                       ("laughs", "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + LAUGHS), ("latin", "# \xe9")):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="latin-1")
    change = [text.format(tmp=tmp_path) for text in change]
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}", *change))
    assert words in said and not (tmp_path / "out").exists()


@pytest.mark.parametrize("change, words", [
    ("--model.sampling.samples=1000000000", "samples=1000000000 states of"),
    ("--model.sampling.guidance=nan", "model.sampling.guidance"),
    ("--model.sampling.guidance=.nan", "the guidance scale lies between 0 and 1,000,000")])
def test_an_option_of_a_prior_that_cannot_be_meant_is_one_sentence(change, words, prior, measured, tmp_path, capsys):
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", prior, f"--data.xrays={measured}", change))
    assert words in said and not (tmp_path / "out").exists()


def test_a_fault_of_the_projects_own_shows_its_trace_and_on_request_every_refusal_does(measured, tmp_path, monkeypatch):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    with monkeypatch.context() as patch, pytest.raises(TypeError, match="a fault"):
        patch.setattr(SIRT, "solve", lambda *_: exec("raise TypeError('a fault')"))
        main(args)
    monkeypatch.setenv("PHYDICT_TRACEBACK", "1")
    with pytest.raises(ValueError, match="a seed is a whole number"):
        main([*args, "--model.seed=-1"])


def test_medsyns_second_stage_is_refused_before_anything_is_done_where_it_takes_too_much_memory(
        measured, tmp_path, capsys):
    base = write(tmp_path / "base" / "model_1.safetensors", entries(text_unet()))
    second = write(tmp_path / "second" / "model.safetensors", entries(super_resolution_unet())).parent
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", base, f"--data.xrays={measured}",
                                      f"--model.super_resolution.file={second}", "--model.super_resolution.memory=1"))
    assert "(256, 256, 256)" in said and "1 GiB are allowed" in said and "--model.super_resolution.memory " in said
    assert not (tmp_path / "out").exists()


def test_stages_in_each_others_place_are_one_sentence(prior, fine, measured, tmp_path, capsys):
    data = f"--data.xrays={measured}"
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", fine, data))
    assert "fine.safetensors' is a super-resolution stage, but a base prior" in said
    said = refusal(capsys, main, with_prior("predict", tmp_path / "out", prior, data,
                                      f"--model.super_resolution.file={prior}"))
    assert "is a base prior, but a super-resolution stage" in said
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", data, f"--model.super_resolution.file={fine}"))
    assert "SIRT has none" in said


@pytest.mark.parametrize("setting", ["guided=false", "guided=true", "noise_augmentation=0.3", "memory=1",
                                     "sampler=phydict.posterior.DDS"])
def test_settings_of_a_second_stage_are_refused_without_its_file(setting, measured, prior, tmp_path, capsys):
    name, data = setting.partition("=")[0], f"--data.xrays={measured}"
    for run in (sirt("predict", tmp_path / "out", data), with_prior("predict", tmp_path / "out", prior, data)):
        said = refusal(capsys, main, [*run, f"--model.super_resolution.{setting}"])
        assert f"model.super_resolution.{name} means nothing without model.super_resolution.file" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("default")
def test_a_configuration_says_of_any_second_stage_whether_it_is_guided(prior, fine, tmp_path):
    configured = ["-c", "{model: {super_resolution: {guided: false}}}"]
    for file in ([], [f"--model.super_resolution.file={fine}"]):
        args = with_prior("test", tmp_path / str(len(file)), prior, "--data.cts=phantom", "--data.phantoms=1", *ORBIT)
        main([*args, *configured, *file, *["--model.super_resolution.noise_augmentation=0.1"] * len(file)])
    [case] = (tmp_path / "1" / "prior_only").glob("phantom*")
    assert record(case)["settings"]["sr_noise_augmentation"] == 0.1
    assert record(case)["settings"]["second"]["class"] == "PriorOnly"


def test_a_prior_refuses_xrays_of_another_grid(prior):
    posterior = reconstructor(PriorOnly(iterations=1), prior)
    with pytest.raises(ValueError, match="16.*64.*use the prior's grid"):
        posterior.reconstruct(torch.ones(3, 24, 24), Projector(Grid.cube(64), BEAM))


@pytest.mark.parametrize("name, change", [
    ("orbit", "orbit.views=4"), ("simulator", "simulator.noise=0.1"), ("simulation_voxels", "simulation_voxels=128"),
    ("only", "only=nowhere.txt"), ("protocol", "protocol=x2ct"), ("cts", "cts=phantom"), ("phantoms", "phantoms=2"),
    ("source", "source.reports=nowhere.csv")])
def test_what_simulates_x_rays_is_refused_where_they_were_measured(name, change, measured, tmp_path, capsys):
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}", f"--data.{change}"))
    assert f"data.{name} is a setting of test" in said and not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", ["--data.only=ids.txt", "--data.source.reports=reports.csv"])
def test_phantoms_are_not_chosen_among_as_a_folder_s_cts_are(change, tmp_path, capsys):
    assert "the cases are phantoms" in refusal(capsys, main, phantoms(tmp_path / "out", 1, change))
    (tmp_path / "spec.yaml").write_text("phantoms: 1\naxes: {method: [sirt]}")
    option = change.replace("--data.", "--").replace("source.reports", "reports").split("=")
    said = refusal(capsys, main, ["ablate", "-c", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "out"), *option])
    assert "the cases are phantoms" in said and not (tmp_path / "out").exists()


def test_a_number_of_phantoms_is_refused_beside_a_folder_of_cts(cts, tmp_path, capsys):
    said = refusal(capsys, main, sirt("test", tmp_path / "out", f"--data.cts={cts}", *ORBIT, "--data.phantoms=2"))
    assert f"the cases are the CTs of {cts}: leave it out" in said and not (tmp_path / "out").exists()


def test_measured_x_rays_and_their_calibration_are_refused_where_x_rays_are_simulated(measured, tmp_path, capsys):
    assert "leave one out" in refusal(capsys, main, phantoms(tmp_path / "out", 1, f"--data.xrays={measured}"))
    assert "--calibrate" in refusal(capsys, main, phantoms(tmp_path / "out", 1, "--calibrate"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("args, words", [
    ([], ["predict", "test", "ablate", "such as: predict --data.xrays"]),
    (["reconstruct"], ["'reconstruct'", "ablate"]),
    (["--data.xrays", "somewhere"], ["predict", "test", "ablate"]), (["predict"], ["needs data.xrays"]),
    (["test"], ["needs data.cts"]), (["ablate"], ["-c configs/ablate/"]),
    (["ablate", "--phantoms", "3"], ["-c configs/ablate/"])], ids=lambda value: " ".join(value)[:20])
def test_a_missing_command_or_input_says_what_to_give(args, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(capsys, main, args)
    assert all(word in said for word in words), said


@pytest.mark.parametrize("change, words", [
    (["--data.viewz=3"], ["data.viewz"]),
    (["--data.orbit.views=0"], ["one view"]),
    (["--data.orbit.views=some"], ["data.orbit.views", "some"]),
    (["--model.method.init_args.iteration=3"], ["iteration"]),
    (["--data.orbit.source_to_isocentre=2000"], ["isocentre"]),
    (["--config=nowhere.yaml"], ["nowhere.yaml"]),
    (["--model.method=srit"], ["no method 'srit'", "sirt", "phydict_fast", "phydict.posterior.DDS"]),
    (["--config={model: {method: 3}}"], ["model.method"]),
    (["--model.sampling.precision=half"], ["precision is auto, float32 or bfloat16, but 'half' was given"]),
], ids=lambda value: value[0] if value[0].startswith("--") else "")
def test_a_bad_argument_is_one_sentence(change, words, tmp_path, capsys):
    said = refusal(capsys, main, phantoms(tmp_path / "out", 1, *change))
    assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_an_unknown_key_of_a_config_file_is_named(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("model:\n  guidence: 2.0\n")
    args = phantoms(tmp_path / "out", 1, f"--config={tmp_path / 'mine.yaml'}")
    assert "model.guidence" in refusal(capsys, main, args)


def test_an_impossible_setting_is_named_without_the_parsers_noise(prior, tmp_path, capsys):
    said = refusal(capsys, main, ["test", "--model.method=phydict_fast", f"--model.prior={prior}",
                                  "--model.method.init_args.iterations=0"])
    assert "SplitGibbs.iterations is a finite number, 1 or more, but 0" in said and "Union" not in said


def test_an_output_folder_that_cannot_be_is_one_sentence(measured, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper", Path("/proc/phydict")):
        said = refusal(capsys, main, sirt("predict", out, f"--data.xrays={measured}"))
        assert str(out) in said and "model.out" in said
    assert (tmp_path / "file").read_text() == "mine"


def test_a_read_only_disk_is_one_sentence(measured, tmp_path, capsys, monkeypatch):
    def refuse(**_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("phydict.runtime.console.tempfile.TemporaryFile", refuse)
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}"))
    assert "Read-only file system" in said and not (tmp_path / "out").exists()


def test_samples_of_a_method_without_a_prior_are_refused(capsys, measured, tmp_path):
    assert "leave samples out" in refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured}",
                                                        "--model.sampling.samples=3"))


def test_a_run_that_is_not_finite_ends_in_one_sentence_and_leaves_no_case(measured, tmp_path, capsys, monkeypatch):
    solve = SIRT.solve
    monkeypatch.setattr(SIRT, "solve", lambda self, *given: solve(self, *given) * float("nan"))
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    assert "not finite from step 3 of 3 on" in said and not (tmp_path / "sirt" / "anna").exists()


def test_metal_of_more_hu_than_the_window_holds_is_refused_where_it_would_do_nothing(tmp_path, capsys):
    tube = ["--data.simulator=phydict.xray.Polychromatic", "--data.simulator.metal=3000"]
    said = refusal(capsys, main, phantoms(tmp_path / "out", 1, *tube))
    assert "simulator.metal 3000 is reached nowhere" in said and "ends at 1000" in said
    (tmp_path / "spec.yaml").write_text("phantoms: 1\nbase: {simulator: polychromatic, simulator.metal: 3000}\n"
                                        "axes: {method: [sirt]}")
    said = refusal(capsys, main, ["ablate", "-c", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "ablated")])
    assert "simulator.metal 3000 is reached nowhere" in said
    data, window = ReconstructionData(cts="phantom", simulator=Polychromatic(metal=3000.0)), HUWindow(-1000.0, 3000.0)
    assert data.test_cases(Grid.cube(16), window)  # which holds it
