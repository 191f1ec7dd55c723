"""The examples do what their READMEs say, command by command, with a fast method on few voxels where none is named, and
in few iterations where one of phydict's is."""

import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import phydict
from phydict.cli.infer import main as infer
from phydict.evaluation import read_csv

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "data" / "example"
VOLUMES = EXAMPLE / "own_volumes"
FEW = "--model.method.init_args.iterations=2"
FAST = ["--model.method=sirt", FEW, "--model.grid=32"]


def written(out: Path) -> Path:
    """The one record below a folder."""
    [record] = out.rglob("reconstruction.json")
    return record


@pytest.mark.filterwarnings("ignore")  # of a method that is stopped early
@pytest.mark.parametrize("folder", sorted(
    file.parent for file in EXAMPLE.glob("*/README.md") if file.parent != VOLUMES), ids=lambda f: f.name)
def test_the_commands_of_an_examples_readme_run(folder, tmp_path, monkeypatch):
    text = (folder / "README.md").read_text()
    assert text.count("\n") <= 16
    commands = [shlex.split(line) for block in re.findall(r"```\n(.*?)```", text, re.DOTALL) for line in
                block.splitlines()]
    assert any(words[:2] == ["python", "infer.py"] for words in commands)
    monkeypatch.chdir(ROOT)
    for words in commands:
        if words[0] == "export":
            name, _, path = words[1].partition("=")
            assert name == "PYTHONPATH"
            monkeypatch.syspath_prepend(path)
        else:
            named = words[words.index("--model.method") + 1] if "--model.method" in words else None
            more = FAST if named is None else [FEW] if named in phydict.METHODS else []
            infer([*words[2:], *more, f"--model.out={tmp_path}", "--trainer.accelerator=cpu"])
    assert written(tmp_path).with_name("volume.nii.gz").is_file() and (tmp_path / "index.html").is_file()


@pytest.mark.filterwarnings("ignore")
def test_volumes_of_another_program_are_scored_on_the_x_rays_that_it_was_given(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    [block] = re.findall(r"```\n(.*?)```", (VOLUMES / "README.md").read_text(), re.DOTALL)
    block = block.replace("runs/", f"{tmp_path}/").replace("--model.method sirt", f"{shlex.join(FAST[:2])}")
    simulated, predicted, compared = (shlex.split(line, comments=True) for line in block.splitlines())
    with monkeypatch.context() as argv:
        argv.setattr("sys.argv", simulated[1:])
        runpy.run_path(simulated[1], run_name="__main__")
    infer([*predicted[2:], "--trainer.accelerator=cpu"])
    infer([*compared[2:], "--out", str(tmp_path / "out"), "--device", "cpu", "--set", "method=[elsewhere,sirt]",
           "--set", f"elsewhere.method.folder={tmp_path / 'elsewhere' / 'sirt'}", "method.iterations=2"])
    rows = read_csv(tmp_path / "out" / "results.csv")
    for case in {row["case"] for row in rows}:
        elsewhere, here = (next(row for row in rows if (row["case"], row["method"]) == (case, method))
                           for method in ("elsewhere", "sirt"))
        assert elsewhere["psnr"] == pytest.approx(here["psnr"], abs=1e-3)
        assert elsewhere["misfit"] == pytest.approx(here["misfit"], rel=1e-3)


def test_what_no_x_rays_can_be_made_of_for_another_program_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["simulate.py", str(EXAMPLE / "truth.nii.gz"), str(tmp_path / "out"), "--views=0"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(VOLUMES / "simulate.py"), run_name="__main__")
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1 and "views" in said
    assert not (tmp_path / "out").exists()


def test_the_table_of_worked_examples_names_each():
    text = (EXAMPLE.parent / "README.md").read_text()
    assert not [file.parent.name for file in EXAMPLE.glob("*/README.md")
                if f"(example/{file.parent.name}/README.md)" not in text]


def test_the_geometries_are_those_that_the_readmes_speak_of():
    ours, rtk = (phydict.load_xrays(EXAMPLE / "xrays", file) for file in (None, EXAMPLE / "rtk" / "geometry.yaml"))
    assert torch.equal(ours["xrays"], rtk["xrays"])
    for name in ("sources", "detectors", "u", "v"):
        np.testing.assert_allclose(getattr(rtk["beam"], name), getattr(ours["beam"], name), atol=1e-3)
    two = phydict.load_xrays(EXAMPLE / "two_radiographs" / "xrays")
    assert two["display"] and two["xrays"].shape == (2, 112, 112)
    for name, tolerance in (("sources", 1e-2), ("detectors", 1e-2)):
        np.testing.assert_allclose(getattr(two["beam"], name), getattr(ours["beam"], name)[[0, 2]], atol=tolerance)


@pytest.mark.filterwarnings("ignore")
def test_the_walkthrough_prints_and_saves_pictures(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["walkthrough.py", str(tmp_path)])
    few = replace(phydict.METHODS["sirt"], iterations=100)  # 0.7 dB worse than of 1,000
    monkeypatch.setitem(phydict.METHODS, "sirt", few)
    runpy.run_path(str(EXAMPLE / "walkthrough.py"), run_name="__main__")
    said = capsys.readouterr().out
    assert "8 X-rays of 224 x 224 pixels" in said and "740 mm" in said
    errors = {name: float(psnr) for name, psnr in re.findall(r"^3\. (\w+): ([\d.]+) dB, misfit", said, re.MULTILINE)}
    assert errors["phydict_learned"] > errors["sirt"] + 3
    assert re.search(r"the 90% interval holds (8[5-9]|9\d)% of the voxels", said)
    assert {f"{name}{ending}" for name in errors for ending in (".png", ".nii.gz")} | {"comparison.png"} == {
        file.name for file in tmp_path.iterdir()}
