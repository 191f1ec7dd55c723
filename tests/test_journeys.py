"""What the README tells a new user to type runs as it stands there; what is added makes it small, and an option that
has another name by now fails."""

from __future__ import annotations

import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_lines import TINY

import phydict
from phydict.cli.infer import main as infer
from phydict.cli.train import main as train
from phydict.evaluation import read_csv
from phydict.posterior import ProximalCG

ROOT = Path(__file__).parents[1]
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL))
ABLATE_SMALL = ["--device=cpu", "--metrics=[volume]", "--set", "method=tv", "method.iterations=2", "voxels=16",
                  "simulation_voxels=32", "detector=24", "views=2"]
MADE_SMALL = {
    "predict": ["--trainer.accelerator=cpu"],
    "test": ["--trainer.accelerator=cpu", "--data.orbit.views=3", "--data.orbit.detector=[24,24]",
             "--data.orbit.pixel=[24,24]"],
    "fit": [*TINY, "--data.phantoms=0", "--data.holdout.phantoms=0", "--data.holdout.fraction=0.5",
            "--data.loading.workers=0", "--trainer.max_epochs=1"],
    "ablate": ABLATE_SMALL, "export": [], "page": []}
"""What is added to a command: few steps, few voxels, the CPU."""

pytestmark = pytest.mark.filterwarnings("ignore")  # of methods that are stopped early


def blocks(section: str, kind: str = "") -> list[str]:
    """The code blocks of a section in a language."""
    return re.findall(rf"^```{kind}\n(.*?)^```", SECTIONS[section], re.MULTILINE | re.DOTALL)


def commands(section: str) -> list[list[str]]:
    """The words of each command of infer.py and train.py in a section, from the program on; "page <folder>" and
    "ablate" may stand alone."""
    prose = re.sub(r"^```.*?^```", "", SECTIONS[section], flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks(section) for line in block.splitlines()] + re.findall(r"`([^`]+)`", prose)
    lines += [f"infer.py {found}" for line in lines for found in re.findall(r"^ablate .*|\bpage <folder>", line)]
    there = re.sub(r"<(folder of )?CTs>", "cts", "\n".join(lines)).replace("page <folder>", "page runs/reconstructions")
    return [shlex.split(line, comments=True) for line in re.findall(
        r"^(?:python )?((?:infer|train)\.py \w+ .+)$", there, re.MULTILINE)]


def run(words: list[str], *more: str) -> None:
    program, command, *options = words
    (infer if program == "infer.py" else train)([command, *options, *more, *MADE_SMALL[command]])


@pytest.fixture(autouse=True)
def checkout(tmp_path, monkeypatch, cts) -> Path:
    """The present folder is as a checkout's, beside a folder of CTs."""
    for name in ("configs", "data"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "cts").symlink_to(cts)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def few_steps(monkeypatch) -> None:
    """The two methods that are run where none is named take two steps, short ones."""
    short = {"likelihood": ProximalCG(2), "final_likelihood": ProximalCG(2), "subgrid": None, "metal": None}
    few = {"phydict_learned": {"times": (0.2,), "x0_stds": (0.5, 0.3), "start": ProximalCG(2)},
           "phydict_fast": {"iterations": 2}}
    for name, settings in few.items():
        monkeypatch.setitem(phydict.METHODS, name, replace(phydict.METHODS[name], **short | settings))


def test_no_command_is_overlooked():
    found = {name: [" ".join(words[:2]) for words in commands(name)] for name in SECTIONS}
    assert {name: kinds for name, kinds in found.items() if kinds} == {
        "Results at a glance": ["infer.py ablate"], "Command line": [*2 * ["infer.py predict"], "infer.py page"],
        "Train and evaluate": ["train.py fit", "train.py export", "infer.py test", "infer.py ablate"]}
    assert {section for section in SECTIONS if blocks(section, "python")} == {"Python"}
    assert {section for section in SECTIONS if blocks(section, "yaml")} == {"Your X-rays"}


def test_what_is_made_can_be_made():
    goals = re.findall(r"^make (\w+)", "".join(blocks("Install")), re.MULTILINE)
    assert goals == ["demo", "test"]
    assert all(re.search(f"^{goal}:", (ROOT / "Makefile").read_text(), re.MULTILINE) for goal in goals)


def test_the_demo_compares_three_methods(checkout, monkeypatch):
    monkeypatch.setitem(phydict.METHODS, "sirt", replace(phydict.METHODS["sirt"], iterations=2))
    runpy.run_path(str(ROOT / "data" / "example" / "demo.py"), run_name="__main__")
    made = checkout / "runs" / "demo"
    assert (made / "comparison.png").is_file()
    page = (made / "index.html").read_text()
    assert all(f'"folder": "{method}"' in page for method in ("phydict_learned", "phydict_fast", "sirt"))


def test_the_example_is_reconstructed_and_shown(checkout, capsys):
    default, tv, page = commands("Command line")
    run(default, "--model.grid=64")
    run(tv, "--model.method.init_args.iterations=2")
    out = checkout / "runs" / "reconstructions"
    for line in re.findall(r"^[├└]── (\S+)", SECTIONS["Command line"], re.MULTILINE):
        assert (out / "phydict_learned" / "xrays" / line).is_file(), line
    (out / "index.html").unlink()
    run(page)
    assert all(method in (out / "index.html").read_text() for method in ("phydict_learned", '"tv"'))


def test_the_lines_of_python_give_what_they_say(checkout):
    [code], said = blocks("Python", "python"), {}
    exec(code, said)
    assert (checkout / "volume.nii.gz").is_file() and said["half_width"].shape == said["result"].volume.shape


def test_xrays_of_ones_own_are_checked_and_reconstructed_by_the_geometry_that_is_shown(checkout, capsys):
    [geometry] = blocks("Your X-rays", "yaml")
    shape = yaml.safe_load(geometry)["beam"]["orbit"]["shape"]
    own = checkout / "own"
    own.mkdir()
    (own / "geometry.yaml").write_text(geometry)
    for n, view in enumerate(phydict.load_xrays("data/example/xrays")["xrays"].numpy()):
        np.save(own / f"view_{n}.npy", np.kron(view, np.ones((2, 2), np.float32)))
    assert [2 * n for n in view.shape] == shape
    for option in ("--dry_run", "--calibrate"):
        assert f"`{option}`" in SECTIONS["Your X-rays"]
    given = ["infer.py", "predict", "--data.xrays", "own", "--model.method", "sirt"]
    run([*given, "--dry_run"])
    assert (checkout / "runs" / "reconstructions" / "dry_run" / "own.png").is_file()
    (own / "geometry.yaml").write_text(geometry + "uncertain: {detector_shift_mm: 2}\n")
    run([*given, "--calibrate"], "--model.method.init_args.iterations=2", "--model.grid=32")
    assert (checkout / "runs" / "reconstructions" / "sirt" / "own" / "geometry_found.yaml").is_file()


def test_a_prior_is_trained_exported_and_scored_on_held_out_patients(checkout, capsys):
    fit, export, test, table = commands("Train and evaluate")
    run(fit), run(export), run(test)
    [held_out] = (checkout / "runs" / "ct_rate" / "held_out.txt").read_text().split()
    [record] = (checkout / "runs" / "reconstructions").glob("*/*/reconstruction.json")
    assert record.parent.name == held_out
    run(table, "--cts=cts", "--out=runs/table1")
    assert {row["status"] for row in read_csv(checkout / "runs" / "table1" / "results.csv")} == {"ok"}


@pytest.mark.parametrize("name", re.findall(r"\[(\w+)\]\(tests/benchmark", SECTIONS["Results at a glance"]))
def test_a_comparison_is_made_by_its_command(name, checkout):
    [words] = commands("Results at a glance")
    run([word.replace("<name>", name) for word in words])
    assert {row["status"] for row in read_csv(checkout / "runs" / name / "results.csv")} == {"ok"}
    assert (checkout / "runs" / name / "index.html").is_file()
