"""Ablations: what is run, on which X-rays, what a stop leaves, and what tables and plots make of it."""

from __future__ import annotations

import itertools
import random
from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from prior.tiny import tiny_prior

from phydict.ablation import plots, read_specification
from phydict.ablation.nested import changed
from phydict.ablation.summary import summarise
from phydict.ablation.tables import all_tables
from phydict.ablation.trials import refined_from
from phydict.baselines.baseline import Baseline
from phydict.cli.infer import main
from phydict.evaluation import read_csv
from phydict.grid import Grid
from phydict.methods import METHODS
from phydict.posterior import DAPS, SplitGibbs
from phydict.prior import save_prior
from phydict.runtime import profiling
from phydict.runtime.files import alone_in
from phydict.runtime.profiling import profiled
from phydict.units import MU_WATER, HUWindow
from phydict.xray import ConeBeam, Projector

ROOT = Path(__file__).parents[1]
TINY = {"voxels": 16, "detector": 24, "views": 3}
TIMES = ("seconds", "memory")


@dataclass(frozen=True)
class Trace(Baseline):
    """A method of four steps that keeps what it is given, does as it is told, and spoils its own X-rays."""

    citation = "none"
    given = []
    behave = staticmethod(lambda calls: None)

    mu_water: float = MU_WATER
    name: str = "trace"

    def steps(self):
        return 4

    def reconstruct(self, xrays, projector, report="", display=False, seed=0, on_step=lambda: None):
        Trace.given.append((xrays.clone(), seed, report))
        try:
            return super().reconstruct(xrays, projector, report, display, seed, on_step)
        finally:
            xrays.zero_()

    def solve(self, A, y, on_step):
        for _ in range(4):
            on_step()
        Trace.behave(len(Trace.given))
        return A.T(y) / 1e4


@pytest.fixture(autouse=True)
def trace(monkeypatch):
    monkeypatch.setitem(METHODS, "trace", Trace())
    monkeypatch.setattr(Trace, "given", [])
    return Trace


def write(folder: Path, **content) -> Path:
    file = folder / "spec.yaml"
    file.write_text(yaml.safe_dump({"out": str(folder / "out"), "phantoms": 2, "base": TINY} | content))
    return file


def ablate(folder: Path, **content) -> list[dict]:
    """The rows after a run."""
    main(["ablate", "-c", str(write(folder, **content)), "--device", "cpu"])
    return read_csv(folder / "out" / "results.csv")


def lasting(rows: list[dict]) -> list[dict]:
    """Rows without what the clock decides."""
    return [{k: v for k, v in row.items() if not any(word in k for word in TIMES)} for row in rows]


def test_a_stopped_run_loses_no_row_and_ends_as_if_it_had_not_been_stopped(tmp_path, monkeypatch, trace):
    axes = {"method": ["trace", "sirt"], "seed": [0, 1], "method.iterations": [2]}
    (tmp_path / "whole").mkdir()
    whole = ablate(tmp_path / "whole", axes=axes)
    assert len(whole) == 8 and {row["status"] for row in whole} == {"ok"}

    def stop(calls):
        if calls == before + 4:  # the second case's warm call is that of the first case: 2 + 2 calls for two seeds
            raise KeyboardInterrupt

    before = len(trace.given)
    monkeypatch.setattr(trace, "behave", staticmethod(stop))
    with pytest.raises(SystemExit) as stopped:
        ablate(tmp_path, axes=axes)
    assert stopped.value.code == 130
    kept = {row["key"]: row for row in read_csv(tmp_path / "out" / "results.csv")}
    assert 0 < len(kept) < 8
    monkeypatch.setattr(trace, "behave", staticmethod(lambda calls: None))
    resumed = ablate(tmp_path, axes=axes)
    assert lasting(resumed) == lasting(whole)
    assert all(row == kept[row["key"]] for row in resumed if row["key"] in kept)


def test_nothing_is_run_again_and_tables_and_plots_come_back(tmp_path, trace):
    content = {"axes": {"method": ["trace", "sirt"], "method.iterations": [2], "views": [2, 3]}}
    rows = ablate(tmp_path, **content)
    calls, out = len(trace.given), tmp_path / "out"
    made = {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".md", ".tex", ".csv")}
    pictures = [path for path in out.iterdir() if path.suffix == ".png"]
    assert {p.name.split("_")[0] for p in pictures} >= {"pareto", "stages"} and "tables.tex" in made
    assert all(path.name in (out / "index.html").read_text() for path in pictures)
    for path in pictures:
        path.unlink()
    assert ablate(tmp_path, **content) == rows and len(trace.given) == calls
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name in made} == made
    assert all(path.exists() for path in pictures)


def test_an_axis_that_grows_runs_what_is_new_alone(tmp_path, trace):
    first = ablate(tmp_path, axes={"method": ["trace"], "views": [2]})
    calls = len(trace.given)
    both = ablate(tmp_path, axes={"method": ["trace"], "views": [3, 2]})
    assert len(trace.given) == calls + 3  # a warm call and two cases
    assert [row["views"] for row in both] == [3, 3, 2, 2] and both[2:] == first
    again = ablate(tmp_path, axes={"method": ["trace"], "views": [3]})
    assert {row["key"] for row in again} == {row["key"] for row in both} and len(trace.given) == calls + 3


def test_all_methods_see_the_same_xrays_and_score_as_in_a_test_of_their_own(tmp_path, monkeypatch, trace):
    monkeypatch.setitem(METHODS, "trace again", Trace())
    rows = ablate(tmp_path, axes={"method": ["trace", "trace again", "sirt"], "method.iterations": [3]})
    calls = {seed: [] for _, seed, _ in trace.given}
    for xrays, seed, report in trace.given:
        calls[seed].append(xrays)
        assert report == ""
    assert len(calls) == 2 and all(len(seen) >= 2 for seen in calls.values())
    assert all(torch.equal(seen[0], other) for seen in calls.values() for other in seen)
    assert not torch.equal(*(seen[0] for seen in calls.values()))
    main(["test", "--model.method=sirt", "--data.cts=phantom",
          "--data.phantoms=2", "--data.orbit.views=3", "--data.orbit.detector=[24,24]",
          f"--data.orbit.pixel=[{560 / 24},{560 / 24}]",
          "--model.method.init_args.iterations=3", "--model.grid=16", f"--model.out={tmp_path}",
          "--trainer.accelerator=cpu"])
    for own in read_csv(tmp_path / "sirt" / "results.csv"):
        (row,) = (row for row in rows if row["method"] == "sirt" and row["case"] == own["case"])
        for name in ("psnr", "ssim", "mae_hu", "psnr_lung", "psnr_body", "misfit", "projector_calls"):
            assert row[name] == own[name], name


def test_one_untimed_call_per_setting_stops_after_two_steps(tmp_path, monkeypatch, trace):
    steps = []
    solve = trace.solve
    monkeypatch.setattr(trace, "solve", lambda self, A, y, on_step: solve(
        self, A, y, lambda: (steps.append(len(trace.given)), on_step())))
    ablate(tmp_path, axes={"method": ["trace"]})
    assert [len(list(group)) for _, group in itertools.groupby(steps)] == [2, 4, 4]


@pytest.mark.parametrize("error, status, again", [(ValueError("Two\nlines."), "refused", 0),
                                                  (RuntimeError("no memory"), "failed", 1)])
def test_a_method_that_gives_up_is_a_row_with_its_sentence(tmp_path, monkeypatch, trace, error, status, again):
    def give_up(calls):
        raise error

    monkeypatch.setattr(trace, "behave", staticmethod(give_up))
    content = {"phantoms": 1, "axes": {"method": ["trace", "sirt", "cgls"], "method.iterations": [2]}}
    rows = ablate(tmp_path, **content)
    assert [row["status"] for row in rows] == [status, "ok", "ok"]
    assert rows[0]["error"].endswith(" ".join(str(error).split())) and "psnr" not in rows[0]
    table = (tmp_path / "out" / "tables.md").read_text()
    assert "| trace | – |" in table and rows[0]["error"] in table
    calls = len(trace.given)
    ablate(tmp_path, **content)
    assert (len(trace.given) > calls) == bool(again)


def test_a_setting_that_means_nothing_to_a_method_does_not_multiply_it(tmp_path):
    trials = read_specification(write(
        tmp_path, base=TINY | {"voxels": 64}, axes={"method": ["sirt", "phydict_fast"], "guidance": [1, 2],
                                                    "method.t_start": [0.2, 0.4]})).trials
    assert [trial.name for trial in trials] == ["sirt"] + ["phydict_fast"] * 4
    assert "guidance" not in trials[0].columns and trials[-1].columns["method.t_start"] == 0.4
    assert trials[-1].guidance == 2.0 and trials[-1].method.t_start == 0.4


def test_methods_without_a_prior_take_the_grid_and_window_of_those_with_one(tmp_path):
    save_prior(tiny_prior(False), tmp_path / "tiny.safetensors")
    sirt, fast = read_specification(write(tmp_path, base={"prior": str(tmp_path / "tiny.safetensors")},
                                          axes={"method": ["sirt", "phydict_fast"]})).trials
    assert sirt.scene()[0].shape == (16, 16, 16) and sirt.scene()[1] == fast.scene()[1] != HUWindow()
    assert sirt.acquisition() == fast.acquisition()


def test_named_variants_change_a_method_under_the_axes(tmp_path):
    methods = {"mine": {"of": "phydict_paper", "method.likelihood.reward.lpips": 0, "method.iterations": 7}}
    one, two = read_specification(write(tmp_path, base={}, methods=methods,
                                        axes={"method.init_args.iterations": [7, 9]})).trials
    assert (one.name, two.name) == ("mine", "mine") and (one.method.iterations, two.method.iterations) == (7, 9)
    assert one.method.likelihood.reward.lpips == 0
    assert changed(one.method, {"likelihood.reward.lpips": 1.0, "iterations": 50}, "method") == METHODS["phydict_paper"]


@pytest.mark.parametrize("content", [
    {"axes": {"method": ["phydict_fast"], "method.init_args.likelihood.variation": [1]}},
    {"base": {"method.likelihood.variation": 1}, "axes": {"method": ["phydict_fast"]}},
    {"methods": {"mine": {"of": "phydict_fast", "method.likelihood.variation": 1}}},
    {"axes": {"method": ["phydict_fast"], "method.likelihood": [{"init_args": {"variation": 1}}]}}])
def test_an_old_setting_is_refused_with_its_new_name(tmp_path, content):
    with pytest.raises(ValueError, match="likelihood.*variation is now tv_weight: rename it"):
        read_specification(write(tmp_path, **content))


@pytest.mark.parametrize("file", sorted((ROOT / "configs" / "ablate").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_shipped_comparison_is_one(file):
    assert read_specification(file, phantoms=1).trials


def test_a_method_by_the_path_of_its_class_is_run_with_its_settings(tmp_path):
    path = f"{Trace.__module__}.{Trace.__qualname__}"
    methods = {name: {"of": of, "method.iterations": count} for name, of, count in (
        ("own", "phydict.baselines.SIRT", 3), ("shorter", "phydict.baselines.SIRT", 2), ("named", "sirt", 3))}
    rows = ablate(tmp_path, phantoms=1, methods=methods, axes={"method": [*methods, path, "trace"]})
    assert [(row["method"], row["status"]) for row in rows] == [(name, "ok") for name in (*methods, path, "trace")]
    own, shorter, named, by_path, trace = (row["psnr"] for row in rows)
    assert own == named != shorter and by_path == trace


def test_a_projector_is_an_axis_on_the_same_xrays_and_the_automatic_one_keeps_its_rows(tmp_path, trace):
    plain = ablate(tmp_path, phantoms=1, axes={"method": ["trace"]})
    rows = ablate(tmp_path, phantoms=1, axes={"method": ["trace"], "projector": ["auto", "siddon", "joseph"]})
    assert rows[0]["key"] == plain[0]["key"] and [row["projector"] for row in rows] == ["auto", "siddon", "joseph"]
    assert len({row["misfit"] for row in rows}) == 3 and {row["status"] for row in rows} == {"ok"}
    assert all(torch.equal(trace.given[0][0], xrays) for xrays, _, _ in trace.given)


def test_a_geometry_file_is_an_axis_with_views_of_its_own(tmp_path, trace):
    orbit = {"views": 2, "source_to_detector": 1020, "source_to_isocentre": 740, "shape": [24, 24], "pixel": 24}
    for name, change in {"tilted": {"tilt_degrees": 5}, "four": {"views": 4}}.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"orbit": orbit | change}))
    files = [str(tmp_path / f"{name}.yaml") for name in ("tilted", "four")]
    rows = ablate(tmp_path, base={"method": "trace", "voxels": 16}, axes={"geometry": files})
    assert [(Path(row["geometry"]).stem, row["views"]) for row in rows] == [("tilted", 2)] * 2 + [("four", 4)] * 2
    assert {len(xrays) for xrays, *_ in trace.given} == {2, 4}
    assert "by geometry" in (tmp_path / "out" / "tables.md").read_text()
    assert [file.name for file in (tmp_path / "out").glob("*.png")] == ["geometry.png"]


def test_an_orbits_setting_means_nothing_beside_a_geometry_file(tmp_path):
    with pytest.raises(ValueError, match="the setting views means nothing"):
        read_specification(write(tmp_path, base={"method": "sirt", "voxels": 16, "geometry": "arc_90", "views": 3}))


def test_set_takes_the_place_of_a_files_axis_base_and_product(tmp_path):
    file = write(tmp_path, products=[{"base": {"seed": 3}, "axes": {"method": ["sirt", "tv"], "views": [2, 4]}},
                                     {"axes": {"method": ["cgls"]}}])
    trials = read_specification(file, ["method=[sirt,cgls]", "views=5", "seed=[1,2]", "voxels=24"]).trials
    assert {(t.name, t.data.beam.views, t.seed, t.scored().shape[0]) for t in trials} == {
        (name, 5, seed, 24) for name in ("sirt", "cgls") for seed in (1, 2)}


@pytest.mark.parametrize("changes, words", [
    (["views"], "name=value"), (["=3"], "name=value"), (["views=[2"], "value of views is not valid YAML"),
    (["view=3"], "no setting 'view'"), (["projector=lines"], "no projector 'lines'"), (["method.steps=2"], "nothing"),
    (["method=[no_module.Sampler]"], "no_module.Sampler cannot be made .*importable"), (["method=[sart]"], "'sart'"),
    (["method=[pathlib.Path]"], "pathlib.Path is no method"), (["method=[sys.exit]"], "sys.exit is no method"),
    (["views=[]"], "at least one value")])
def test_a_set_that_cannot_be_meant_is_one_sentence(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words):
        read_specification(write(tmp_path, axes={"method": ["sirt"]}), changes)


def test_settings_that_hold_each_other_are_changed_together():
    method = changed(METHODS["pnp_dm"], {"iterations": 8, "burn_in": 6}, "method")
    assert (method.iterations, method.burn_in) == (8, 6)
    assert changed(DAPS(), {"likelihood": {"class_path": "phydict.posterior.ExactDraw"}, "likelihood.iterations": 3},
                   "method").likelihood.iterations == 3


def test_delta_keeps_the_length_of_a_step():
    paper = METHODS["phydict_paper"]
    assert refined_from(paper, 0.8) == paper
    for delta in (0.1, 0.5, 0.99):
        method = refined_from(SplitGibbs(100), delta)
        assert method.ec_delta / method.ec_steps == pytest.approx(1 / 100)
    assert refined_from(paper, 0.0).steps() == paper.iterations


@pytest.mark.parametrize("content, words", [
    ({"axes": {"veiws": [2]}}, ["'veiws'", "views"]),
    ({"axes": {"method": ["sirt"], "veiws": [2]}}, ["'veiws'", "views"]),
    ({"axes": {"method": ["sart"]}}, ["'sart'", "sirt"]), ({"axes": {"method": [["sirt"]]}}, ["['sirt']"]),
    ({"axes": {"method": []}}, ["method", "at least one"]), ({"axes": {"method": "sirt"}}, ["list", "'sirt'"]),
    ({"axes": {"method": ["sirt"], "views": ["two"]}}, ["views", "int", "'two'"]),
    ({"axes": {"method": ["sirt"], "views": [0]}}, ["one view"]),
    ({"axes": {"method": ["sirt"], "views": [None]}}, ["views", "None"]),
    ({"axes": {"method": ["sirt"], "method.iterations": [2.5]}}, ["method.iterations", "2.5"]),
    ({"axes": {"method": ["sirt"], "method.steps": [2]}}, ["method.steps", "iterations"]),
    ({"axes": {"method": ["tv"], "method.iterations": [0]}}, ["iterations of at least 1"]),
    ({"axes": {"method": ["sirt"], "delta": [0.5]}}, ["delta"]),
    ({"axes": {"method": ["sirt"], "simulator": ["real"]}}, ["'real'", "polychromatic"]),
    ({"axes": {"method": ["sirt"], "simulator.kvp": [80]}}, ["simulator.kvp", "photons"]),
    ({"axes": {"method": ["sirt", "prior_only"], "voxels": [16, 24]}}, ["one grid"]),
    ({"base": {"side": 200.0}, "axes": {"method": ["sirt"]}}, ["side", "give them too"]),
    ({"axes": {"method": ["sirt"]}, "cts": "folder"}, ["one of the two"]),
    ({"axes": {}}, ["no method"]), ({"products": []}, ["products"]), ({"products": [{"axis": {}}]}, ["'axis'"]),
    ({"axes": {"method": ["sirt"]}, "products": []}, ["not both"]), ({"axs": {}}, ["'axs'"]),
    ({"methods": {"mine": {"of": "sart"}}}, ["'sart'"]), ({"methods": {"mine": {}}}, ["'mine'"]),
    ({"methods": {"mine": {"of": "sirt", "method.iteration": 2}}}, ["method.iteration ", "iterations"]),
    ({"base": TINY | {"method.iteration": 3}, "axes": {"method": ["sirt"]}}, ["method.iteration "]),
    ({"axes": {"method": ["phydict_fast"], "method.iterations": [1]}}, ["phydict_fast: ", "2 iterations"]),
    ({"axes": [1]}, ["axes", "mapping"])], ids=lambda value: str(value)[:60] if isinstance(value, dict) else "")
def test_a_specification_that_cannot_be_meant_is_one_sentence(tmp_path, capsys, content, words):
    said = refusal(capsys, main, ["ablate", "-c", str(write(tmp_path, **content))])
    assert "spec.yaml" in said and all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_the_table_of_another_comparison_is_left_alone(tmp_path, capsys, trace):
    ablate(tmp_path, phantoms=1, base=TINY, axes={"method": ["trace"]})
    before = {file: file.read_bytes() for file in (tmp_path / "out").iterdir()}
    other = write(tmp_path, phantoms=1, base=TINY | {"seed": 7}, axes={"method": ["trace"]})
    assert "another out" in refusal(capsys, main, ["ablate", "-c", str(other)])
    assert {file: file.read_bytes() for file in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize("name", ["tables.md", "picture.png"])
def test_what_other_programs_wrote_is_left_alone(tmp_path, capsys, trace, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    said = refusal(capsys, main, ["ablate", "-c", str(write(tmp_path, axes={"method": ["trace"]})), "--device", "cpu"])
    assert f"holds {name}, but no results.csv of this command" in said and not trace.given
    assert (tmp_path / "out" / name).read_text() == "mine"


def test_arguments_and_files_that_cannot_be_meant_are_one_sentence(tmp_path, capsys):
    assert "nowhere.yaml" in refusal(capsys, main, ["ablate", "-c", str(tmp_path / "nowhere.yaml")])
    file = write(tmp_path, axes={"method": ["trace"]})
    assert "nowhere" in refusal(capsys, main, ["ablate", "-c", str(file), "--cts", str(tmp_path / "nowhere")])
    (tmp_path / "bad.yaml").write_text("axes: [")
    assert "bad.yaml is not valid YAML" in refusal(capsys, main, ["ablate", "-c", str(tmp_path / "bad.yaml")])
    with alone_in(tmp_path / "out", "out"):
        assert "another run" in refusal(capsys, main, ["ablate", "-c", str(file)])
    (tmp_path / "out" / "results.csv").write_text("case,method\na,b\n")
    assert "another out" in refusal(capsys, main, ["ablate", "-c", str(file)])


@pytest.mark.parametrize("config", sorted((ROOT / "configs" / "ablate").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_committed_specification_can_be_run(config):
    specification = read_specification(config, phantoms=1)
    assert len(specification.trials) >= 5
    if config.stem == "pareto":
        told = yaml.safe_load(config.read_text())["methods"]
        for views in (2, 8):
            names = {trial.name for trial in specification.trials if trial.data.beam.views == views}
            of = {told.get(name, {}).get("of", name) for name in names}
            assert of >= set(METHODS) - {"trace", "phydict_released"}


def test_parts_of_the_time_are_parts_of_it_and_calls_are_counted(tmp_path):
    save_prior(tiny_prior(False), tmp_path / "tiny.safetensors")
    rows = ablate(tmp_path, phantoms=1, base=TINY | {"prior": str(tmp_path / "tiny.safetensors")},
                  axes={"method": ["phydict_fast", "dps", "dds"], "method.iterations": [3], "samples": [1, 2]})
    assert [row["samples"] for row in rows] == [1, 2] * 3 and {row["status"] for row in rows} == {"ok"}
    for row in rows:
        assert row["network_calls"] == 3 * row["samples"] and row["projector_calls"] > 3
        assert 0 < row["seconds_network"] + row["seconds_projector"] <= row["seconds"]
        assert row["seconds"] == pytest.approx(sum(row[f"seconds_{stage}"] for stage in ("prepare", "sample", "score")))
        assert row["prior"].endswith("tiny.safetensors") and row["grid"] == "16x16x16"


@pytest.mark.filterwarnings("default")
def test_a_doubtful_ct_marks_its_rows_and_the_tables(tmp_path, trace):
    image = nibabel.Nifti1Image(np.zeros((12, 12, 12), np.float32) + 24, np.diag([30.0, 30.0, 30.0, 1.0]))
    image.set_sform(image.affine, code=1)
    (tmp_path / "cts").mkdir()
    nibabel.save(image, tmp_path / "cts" / "shifted.nii.gz")
    file = write(tmp_path, cts=str(tmp_path / "cts"), base=TINY, axes={"method": ["trace"], "views": [2, 3]})
    content = {k: v for k, v in yaml.safe_load(file.read_text()).items() if k != "phantoms"}
    file.write_text(yaml.safe_dump(content))
    main(["ablate", "-c", str(file), "--device", "cpu"])
    rows = read_csv(tmp_path / "out" / "results.csv")
    assert len(rows) == 2 and all("shifted does not look like HU" in row["warning"] for row in rows)
    assert "Doubtful cases, by the column warning: trace: shifted." in (
        tmp_path / "out" / "tables.md").read_text()


def test_a_profile_counts_a_projector_whoever_runs_it():
    A, x = Projector(Grid.cube(8), ConeBeam.orbit(2, 1020, 740, (12, 12), 40.0)), torch.rand(1, 1, 8, 8, 8)
    with profiled() as profile, profiling.stage("sample"):
        A(x.requires_grad_()).sum().backward()
    assert profile.uses["sample / projector"].calls == 2
    assert profile.seconds("projector", "network") == {"projector": profile.uses["sample / projector"].seconds}


def row(case: str, method: str, psnr: float | None, **more) -> dict:
    scores = {"status": "refused", "error": "no."} if psnr is None else {
        "status": "ok", "psnr": psnr, "ssim": psnr / 40, "mae_hu": 100.0, "misfit": 1 / psnr, "seconds": 1.0,
        "network_calls": 4}
    return {"case": case, "method": method, "views": 8, "simulator": "ideal", "seed": 0, "grid": "64x64x64"} | more | \
        scores


def test_a_case_counts_once_whatever_its_seeds_and_a_missing_case_takes_a_method_out():
    rows = [row("a", "x", 10.0), row("a", "x", 20.0, seed=1), row("b", "x", 35.0), row("a", "y", 39.0),
            row("b", "y", None), row("a", "z", 5.0), row("b", "z", 5.0)]
    x, y, z = summarise(rows)
    assert x.means["psnr"] == 25.0 and x.complete and not y.complete and y.label == "y (1 of 2 cases)"
    table, differences = all_tables([x, y, z], rows)
    text = table.markdown()
    assert "| x | **0.625 [0.375, 0.875]** | **25.00 [15.00, 35.00]** |" in text
    assert "| y (1 of 2 cases) | 0.975 | 39.00 |" in text
    assert "y: refused: no." in text and "| z | <u>0.125 [0.125, 0.125]</u> |" in text
    assert differences.title == "Methods, K = 8, ideal: less x, case by case"
    assert "| y (1 of 2 cases) | 0.600 | 24.00 |" in differences.markdown()
    assert "| z | -0.500 [-0.750, -0.250] | -20.00 [-30.00, -10.00] |" in differences.markdown()


def test_each_condition_has_its_table_and_the_best_setting_stands_for_a_method():
    rows = [row("a", "x", 20.0 + n + views / 10, views=views, **{"method.iterations": n}) for views in (2, 8)
            for n in (1, 3, 2)] + [row("a", "y", 21.0, views=views) for views in (2, 8)]
    tables = {table.title: table for table in all_tables(summarise(rows), rows)}
    best = tables["Methods, K = 8: each at its setting of highest mean PSNR"]
    assert [label for label, _, _ in best.lines] == ["x, iterations 3", "y"]
    assert len(tables["Methods, K = 2: all settings"].lines) == 4
    assert tables["PSNR (dB) ↑ against the number of views"].header == ["method", "K = 2", "K = 8"]
    assert tables["PSNR (dB) ↑ against the number of views"].lines[1] == ("x, iterations 3", True, [23.2, 23.8])


def test_the_table_of_delta_has_the_misfit_beside_ssim():
    rows = [row("a", "x", 20.0 + d, delta=d) for d in (0.0, 0.8, 0.1)]
    table = next(t for t in all_tables(summarise(rows), rows) if "delta" in t.header)
    assert table.header[1:3] == ["SSIM ↑", "misfit ↓"]
    assert [label for label, _, _ in table.lines] == ["0", "0.1", "0.8"]
    assert [values[:2] for _, _, values in table.lines] == [[(20 + d) / 40, 1 / (20 + d)] for d in (0.0, 0.1, 0.8)]


def test_the_front_holds_what_nothing_beats():
    draw = random.Random(1)
    for _ in range(100):
        points = [(draw.randint(1, 6), draw.randint(1, 6)) for _ in range(draw.randint(1, 12))]
        kept = [points[i] for i in plots.front(points)]
        assert kept == sorted(set(kept)) and sorted(kept, key=lambda p: p[1]) == kept
        for cost, gain in points:
            beaten = any(c <= cost and g >= gain and (c, g) != (cost, gain) for c, g in points)
            assert ((cost, gain) in kept) != beaten


def test_every_plot_that_the_rows_allow_is_drawn(tmp_path):
    rows = [row("a", method, 20.0 + n, views=views, seconds_network=0.5, **more) for views in (1, 8)
            for n, (method, more) in enumerate([("x", {"delta": 0.0}), ("x", {"delta": 0.8}), ("y", {})])]
    files = plots.write_plots(tmp_path, summarise(rows))
    assert sorted(file.name for file in files) == sorted(p.name for p in tmp_path.iterdir())
    assert {file.stem for file in files} == {"pareto_K_1", "pareto_K_8", "stages_K_1", "stages_K_8", "views", "delta"}


def test_results_are_never_written_among_the_cts(tmp_path, capsys):
    cts = tmp_path / "cts"
    cts.mkdir()
    nibabel.save(nibabel.Nifti1Image(np.zeros((20, 20, 20), np.float32), np.diag([10.0, 10, 10, 1])), cts / "a.nii.gz")
    for out in (cts, cts / "out"):
        file = write(tmp_path, axes={"method": ["trace"]}, cts=str(cts), out=str(out), phantoms=None)
        assert "give another out" in refusal(capsys, main, ["ablate", "-c", str(file), "--device", "cpu"])
    assert [path.name for path in cts.iterdir()] == ["a.nii.gz"]


def test_a_device_that_is_not_there_is_refused(tmp_path, capsys):
    file = write(tmp_path, axes={"method": ["trace"]})
    assert "--device warp cannot be used" in refusal(capsys, main, ["ablate", "-c", str(file), "--device", "warp"])


def test_a_table_with_words_for_numbers_is_refused_by_row_and_column(tmp_path, capsys):
    (row, *_) = ablate(tmp_path, axes={"method": ["trace"]})
    table = tmp_path / "out" / "results.csv"
    table.write_text(table.read_text().replace(repr(row["psnr"]), "1e999"))
    said = refusal(capsys, main, ["ablate", "-c", str(tmp_path / "spec.yaml"), "--device", "cpu"])
    assert f"psnr of row {row['key']} is '1e999'" in said and "results.csv" in said


def test_dollars_in_the_name_of_a_method_are_no_formula_of_its_plots(tmp_path):
    names = ["a$\\frac$", "$x|[/b]"]
    rows = ablate(tmp_path, methods={name: {"of": "sirt", "method.iterations": 2} for name in names})
    assert {row["method"] for row in rows} == set(names) and list((tmp_path / "out").glob("*.png"))


@pytest.mark.parametrize("content, words", [
    ({"methods": {"mine": {"of": "trace", "methodnull.x": 1}}}, "methodnull.x means nothing"),
    ({"products": [{"axes": {"method": ["trace"], "seed": list(range(500))}}] * 5}, "2,500 combinations"),
    ({"axes": {"method": ["trace"], "views": ["9" * 500]}}, "an orbit needs at least one view")], ids=["part",
    "products", "long"])
def test_what_a_specification_cannot_mean_is_one_short_sentence(tmp_path, content, words):
    with pytest.raises(ValueError, match=words) as caught:
        read_specification(write(tmp_path, **content))
    assert len(str(caught.value)) < 400
