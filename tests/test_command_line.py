"""What the command lines say when they stop."""

import errno
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from command_lines import refusal

from phydict.cli.infer import main as infer
from phydict.cli.infer import with_methods
from phydict.cli.train import main as train
from phydict.runtime.configurations import with_configurations
from phydict.runtime.console import check_writable, cli_errors, noted, quiet
from phydict.runtime.shipped import shipped
from phydict.runtime.warning import warn

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_one_sentence_that_says_how_to_resume(number, capsys):
    with pytest.raises(SystemExit) as stopped, cli_errors():
        error = OSError(number, os.strerror(number), "metrics.csv")
        error.add_note("add --ckpt_path")
        raise error
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1
    assert os.strerror(number) in said and "'metrics.csv'" in said and "free some space; to resume, add --ckpt" in said


def used_up() -> None:
    raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 2.00 GiB")


@pytest.mark.parametrize("take, words", [
    (lambda: torch.empty(2**50), "can't allocate memory"), (lambda: np.empty(2**50), "Unable to allocate"),
    (used_up, "CUDA out of memory. Tried to allocate 2.00 GiB")], ids=["torch", "numpy", "device"])
def test_memory_that_gives_out_is_one_sentence(take, words, capsys):
    with pytest.raises(SystemExit) as stopped, cli_errors():
        take()
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and said.startswith("error: memory gave out (")
    assert words in said and "give fewer voxels" in said


class Wide(torch.utils.data.Dataset):
    """One case of more than any machine's shared memory."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.ones(1).expand(2**45)


def test_shared_memory_that_gives_out_is_one_sentence(capsys):
    with pytest.raises(SystemExit) as stopped, cli_errors():
        next(iter(torch.utils.data.DataLoader(Wide(), num_workers=1)))
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and said.startswith("error: the processes that load data ")
    assert "shared memory" in said and "--shm-size" in said and "data.loading.workers" in said


def test_what_is_closed_before_the_start_is_not_written_to(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    with cli_errors():
        print("volume")
    monkeypatch.undo()
    monkeypatch.setattr(sys, "stderr", None)
    with pytest.raises(SystemExit) as stopped, cli_errors():
        raise ValueError("what was wrong")
    assert stopped.value.code == 2 and capsys.readouterr().out == ""


def test_other_errors_of_torch_show_where_they_arise(capsys):
    with pytest.raises(RuntimeError, match="must match the size") as error, cli_errors():
        torch.zeros(2) + torch.zeros(3)
    assert type(error.value) is RuntimeError and not capsys.readouterr().err


@pytest.mark.parametrize("script", ["infer.py", "train.py"])
def test_ctrl_c_during_the_imports_shows_no_trace(script, tmp_path):
    slow = tmp_path / "phydict" / "cli" / script
    slow.parent.mkdir(parents=True)
    for package in slow.parents[:2]:
        (package / "__init__.py").touch()
    slow.write_text("import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
                    "signal.raise_signal(signal.SIGINT)\n")
    shutil.copy(ROOT / script, tmp_path)
    stopped = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert (stopped.returncode, stopped.stdout, stopped.stderr) == (130, "", "")


@pytest.fixture
def empty(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("before", [["-c"], ["--config"]])
@pytest.mark.parametrize("given", ["phydict_fast", "phydict_fast.yaml", "configs/reconstruct/phydict_fast.yaml"])
def test_a_shipped_configuration_is_found_by_name_and_by_path_from_anywhere(empty, before, given):
    file = str(shipped("configs/reconstruct/phydict_fast.yaml"))
    for args in ([*before, given], [f"{before[0]}={given}"]):
        assert with_configurations(["predict", *args, "--model.seed", "1"], ("reconstruct",)) == [
            "predict", f"--config={file}", "--model.seed", "1"]


def test_what_is_there_comes_before_what_is_shipped(empty):
    own = empty / "configs" / "reconstruct" / "phydict_fast.yaml"
    own.parent.mkdir(parents=True)
    own.touch()
    (empty / "phydict_fast").touch()
    for given in ("configs/reconstruct/phydict_fast.yaml", "phydict_fast", str(own), "{model: {seed: 1}}"):
        for args in (["-c", given], [f"-c{given}"]):
            assert with_configurations(args, ("reconstruct",)) == [f"--config={given}"]


@pytest.mark.parametrize("given", [["-cmine.yaml"], ["-c", "a:b.yaml"], ["-ca:b.yaml"], ["--config=a:b.yaml"]],
                         ids=repr)
def test_a_configuration_names_its_method_however_its_file_is_given(empty, given):
    for name in ("mine.yaml", "a:b.yaml"):
        (empty / name).write_text("model: {method: sirt}")
    (arg,) = with_methods(given)
    assert "phydict.baselines.sirt.SIRT" in arg


@pytest.mark.parametrize("text", [
    "{model: {method: sirt}}", "model: {method: tv, grid: 32, name: mine, seed: 4}", "model: {name: my_method}",
    "model: {method: phydict.posterior.DDS}", "data: {xrays: x}"])
def test_a_configuration_on_the_command_line_means_what_it_means_in_a_file(empty, text):
    (empty / "mine.yaml").write_text(text)
    in_file, inline = (with_methods(["-c", given])[0].removeprefix("--config=") for given in ("mine.yaml", text))
    assert inline == (text if in_file == "mine.yaml" else in_file)


@pytest.mark.parametrize("text, words", [
    ("model: {method: mine}", "there is no method 'mine'"), ("model: [1]", "a mapping of settings, such as `model:"),
    ("{model: {seed: 1, seed: 2}}", "`model.seed` is given twice"), ("model: {method: tv", "config is not valid YAML"),
    ("- model: {seed: 1}", "a mapping of settings, such as `model:"),
    ("model: {name: my_method}", "--model.method.init_args.iterations is a setting of a method, but none was given")])
def test_a_configuration_on_the_command_line_that_cannot_be_meant_is_one_sentence(capsys, text, words):
    said = refusal(capsys, infer, ["predict", "-c", text, "--model.method.init_args.iterations=4"])
    assert words in said


@pytest.mark.parametrize("main, command, names", [
    (infer, "predict", ("phydict_fast", "polychromatic")), (infer, "ablate", ("pareto", "views")),
    (train, "fit", ("ct_rate", "super_resolution"))], ids=["infer", "ablate", "train"])
@pytest.mark.parametrize("given", ["phydict_quick", "configs/reconstruct/quick.yaml", "../data/prior"])
def test_an_unknown_configuration_is_one_sentence_that_lists_what_there_is(empty, capsys, main, command, names, given):
    with pytest.raises(SystemExit) as stopped:
        main([command, "-c", given])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and f"no configuration {given}:" in said
    assert all(name in said for name in names)


def test_a_configuration_of_another_command_is_none_of_its_names(empty, capsys):
    with pytest.raises(SystemExit) as stopped:
        train(["fit", "-c", "phydict_fast"])
    assert stopped.value.code == 2 and "no configuration phydict_fast" in capsys.readouterr().err


@pytest.mark.filterwarnings("default")
def test_a_cases_warnings_are_noted_and_shown_with_its_name_however_often_others_gave_them(capsys):
    found = {"anna": [], "bert": []}
    with quiet():
        for name, own in found.items():
            with noted(own, name):
                for _ in range(2):
                    warnings.warn("too dark", stacklevel=1)
                    warnings.warn("not about the case", RuntimeWarning, stacklevel=1)
    assert found == {"anna": ["too dark"], "bert": ["too dark"]}
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "dark" in line] == ["warning: anna: too dark", "warning: bert: too dark"]


@pytest.mark.parametrize("category", [UserWarning, Warning])
def test_a_cases_warnings_are_noted_where_python_is_told_to_show_none(category):
    found: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category)
        with quiet(), noted(found, "anna"):
            warn("too dark")
    assert found == ["too dark"]


BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n" for before, name in zip("abcdefgh", "bcdefghi"))
"""Nine lines of YAML that stand for a thousand million values."""


@pytest.mark.parametrize("name", ["inline", "with:colon.yaml"])
def test_anchors_that_repeat_each_other_are_refused_wherever_they_stand(empty, capsys, name):
    (empty / "with:colon.yaml").write_text(BOMB)
    said = refusal(capsys, infer, ["predict", "-c", BOMB if name == "inline" else name, "--data.xrays", "x"])
    assert "by aliases" in said


@pytest.mark.parametrize("content, words", [
    ("model: {method: {class_path: [a]}}", "`model.method.class_path` is the name of a class"),
    ("model: {method: {class_path: phydict.baselines.SIRT, init_args: [1]}}", "`model.method.init_args` is a mapping"),
    ("trainer: {callbacks: [{class_path: 3}]}", "`trainer.callbacks.class_path` is the name of a class"),
    ("dry_run: often", "dry_run is true or false"), ('model: {name: "a\\0b"}', "give another model.out"),
    ("trainer: {devices: many}", "the settings of trainer")])
def test_a_setting_of_the_wrong_kind_is_one_sentence_that_names_it(empty, capsys, content, words):
    (empty / "mine.yaml").write_text(content)
    with pytest.raises(SystemExit) as stopped:
        infer(["predict", "-c", "sirt", "-c", "mine.yaml", "--data.xrays", str(shipped("data/example/xrays"))])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and words in said


@pytest.mark.parametrize("option, words", [
    ("--model.sampling.guidance=nan", "model.sampling.guidance is a number, but nan was given"),
    ("--model.seed=1.5", "model.seed is a whole number, but 1.5 was given"),
    ("--model.overwrite=maybe", "model.overwrite is true or false, but maybe was given"),
    ("--model.sampling={samples: x}", "model.sampling.samples is a whole number, but x was given"),
    ("--model.grid=big", "model.grid is a whole number or a mapping of settings, but big was given"),
    ("--model.cube.voxels=32", "model.cube is a setting of train.py: give model.grid"),
    ("--model.grid.side=200", "give model.grid.voxels"),
    ("--model.grid.voxels=[8,8]", "model.grid.voxels is a whole number or a list of 3, but [8, 8] was"),
    ("--data.orbit.pixel=[1]", "data.orbit.pixel is a list of 2, but [1] was given"),
    ("--data.simulator=os.system", "data.simulator is the path of a Simulator, but os.system was given"),
    ("--model.method.init_args.mu_water=-1", "error: mu_water, the attenuation of water in 1/mm, is above 0"),
    ("--model.method={class_path: phydict.baselines.SIRT, init_args: {7: 1}}", "model.method: Key must be a string"),
    ("--model.method=a..b", "model.method is the path of a class, but a..b was given"),
    ("--trainer.plugins=os.system", "trainer.plugins is "),
    ("--data.simulator=null", "data.simulator is the path of a Simulator, but null was given"),
    ("--trainer.strategy=ddp_spawn", "by trainer.strategy ddp_spawn processes are copies of this one"),
    ("--trainer.devices=many", "`devices` selected"), ("--config=&a {b: *a}", "config: "),
    ("--model.method=os.system", "model.method is the path of a Sampler or the path of a Reconstructor, but os.system"),
    ("--model.method=nowhere.X", "model.method is the path of a class, but nowhere.X cannot be imported"),
    ("--model.method=phydict.posterior.Sampler", "phydict.posterior.Sampler is abstract: give one derived from it"),
    ("--model.method.init_args=3", "model.method.init_args is a mapping of the settings of phydict.baselines.SIRT"),
    ("--model.method.init_args.iterations=[]", "model.method.init_args.iterations is a whole number, but [] was given"),
    ('--model.method={"class_path": "phydict.baselines.SIRT", "init_args": {"speed": 3}}', "SIRT has no setting speed"),
    ("--trainer.callbacks=3", "trainer.callbacks is a list"), ("--dry_run=7", "--dry_run takes no value, but 7 was"),
    ("--trainer.precision=12", "32-true, 64-true, bf16, but 12 was given"),
    ("--model.method.iteratons=3", "SIRT has no setting iteratons: did you mean iterations?"),
    ("--trainer.speed=3", "there is no option --trainer.speed=3: --help"),
    ("--model.metod=tv", "there is no option --model.metod=tv: did you mean --model.method?"),
    ("--config={model: {samples: 3}}", "there is no option --model.samples: did you mean --model.sampling.samples?"),
    ("--out=x", "there is no option --out=x: did you mean --model.out?")])
def test_an_option_of_the_wrong_kind_is_told_in_words_of_the_settings(empty, capsys, option, words):
    with pytest.raises(SystemExit) as stopped:
        infer(["predict", "-c", "sirt", "--data.xrays", str(shipped("data/example/xrays")), option])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and words in said
    assert not re.search("Parser key|<class|Expected|has no attribute", said)


def test_settings_of_a_method_before_its_name_are_one_sentence(capsys):
    said = refusal(capsys, infer, ["predict", "--model.method.init_args.iterations=5", "--model.method=tv"])
    assert "but 5 was given: settings of a method come after its name" in said


@pytest.mark.parametrize("out", ["x" * 300, "/".join(["x" * 100] * 60), "broken/link"])
def test_an_output_that_cannot_be_is_refused_with_its_option(empty, out):
    (empty / "broken").symlink_to("nowhere")
    with pytest.raises(ValueError, match="give another model.out$"):
        check_writable(Path(out), "model.out")


def test_settings_without_a_method_are_refused_with_the_methods_names(capsys):
    with pytest.raises(SystemExit) as stopped:
        infer(["predict", "--model.method.init_args.iterations=4"])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1
    assert "--model.method.init_args.iterations is a setting of a method, but none was given" in said and "tv" in said


def test_the_help_of_a_class_needs_no_configuration(capsys):
    with pytest.raises(SystemExit) as stopped:
        infer(["predict", "--model.method.help=phydict.baselines.SIRT"])
    assert not stopped.value.code and "--model.method.iterations" in capsys.readouterr().out


def test_neither_picture_engine_nor_cache_that_cannot_be_keeps_a_command_from_starting():
    run = subprocess.run([sys.executable, "-c", "import phydict.cli, matplotlib, torch._dynamo.package; "
                          "print(matplotlib.get_backend())"], cwd=ROOT, capture_output=True, text=True,
                         env=os.environ | {"MPLBACKEND": "nonsense", "TORCHINDUCTOR_CACHE_DIR": "/dev/null/x"})
    assert run.returncode == 0 and run.stdout.lower().strip() == "agg", run.stderr


@pytest.mark.parametrize("own, spins, script", [
    ({}, "3000", "phydict/__init__.py"), ({"GOMP_SPINCOUNT": "7"}, "7", "phydict/__init__.py"),
    ({"OMP_WAIT_POLICY": "active"}, "", "phydict/__init__.py"),
    ({}, "3000", "data/example/demo.py"), ({}, "3000", "data/example/walkthrough.py"),
    ({}, "3000", "data/example/make.py"), ({}, "3000", "data/example/own_volumes/simulate.py")])
def test_threads_spin_shortly_for_each_other_unless_the_environment_says_how(own, spins, script):
    """Which is settled before torch is loaded."""
    left = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    run = subprocess.run([sys.executable, "-c", "import contextlib, os, runpy, sys; sys.modules['torch'] = None\n"
                          f"with contextlib.suppress(ImportError): runpy.run_path({script!r})\n"
                          "print(os.environ.get('GOMP_SPINCOUNT', ''))"],
                         cwd=ROOT, capture_output=True, text=True, env=left | own)
    assert run.stdout.strip() == spins, run.stderr
