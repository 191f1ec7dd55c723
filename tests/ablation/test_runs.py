"""Ablations: what is run, on which X-rays, and what a stop leaves."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from ct_files import save_ct, thorax_hu
from prior.tiny import tiny_prior

from ablation.runs import TINY, Trace, ablate, arguments, write
from phydict.ablation import command, read_specification
from phydict.ablation.run import planned
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.evaluation import read_csv, write_csv
from phydict.grid import Grid
from phydict.inference.data import ReconstructionData
from phydict.inference.scoring import Scoring
from phydict.methods import METHODS
from phydict.prior import save_prior
from phydict.runtime import profiling
from phydict.runtime.files import alone_in, machine
from phydict.runtime.memory import TooLittleMemory
from phydict.runtime.profiling import profiled
from phydict.units import HUWindow
from phydict.xray import ConeBeam, Projector

TIMES = ("seconds", "memory")


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
    page = (tmp_path / "out" / "index.html").read_text()
    assert "trace (1 of 2 cases)" in page and "sirt (1 of 2 cases)" in page and "not run: the run was stopped" in page
    kept = {row["key"]: row for row in read_csv(tmp_path / "out" / "results.csv")}
    assert 0 < len(kept) < 8
    monkeypatch.setattr(trace, "behave", staticmethod(lambda calls: None))
    resumed = ablate(tmp_path, axes=axes)
    assert lasting(resumed) == lasting(whole)
    assert all(row == kept[row["key"]] for row in resumed if row["key"] in kept)


def test_nothing_is_run_again_and_tables_and_plots_come_back(tmp_path, trace, plots):
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


def test_the_untimed_call_ends_no_run_that_is_to_show_where_it_fails(tmp_path, monkeypatch, trace):
    monkeypatch.setenv("PHYDICT_TRACEBACK", "1")
    assert {row["status"] for row in ablate(tmp_path, axes={"method": ["trace"]})} == {"ok"}


@pytest.mark.parametrize("error", [ValueError("No view."), RuntimeError("no memory")])
def test_every_error_of_a_method_shows_where_it_is_asked_to(tmp_path, monkeypatch, trace, error):
    def give_up(calls):
        raise error

    monkeypatch.setenv("PHYDICT_TRACEBACK", "1")
    monkeypatch.setattr(trace, "behave", staticmethod(give_up))
    with pytest.raises(type(error), match=str(error)):
        ablate(tmp_path, axes={"method": ["trace"]})


@pytest.mark.parametrize("error, status, again", [(ValueError("Two\nlines."), "refused", 0),
                                                  (TooLittleMemory("It would take 9 GiB"), "failed", 1),
                                                  (FloatingPointError("Not finite from step 2 on."), "diverged", 0),
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


def test_a_method_that_returns_what_is_not_finite_is_a_diverged_row_without_scores(tmp_path, monkeypatch):
    whole = SIRT.reconstruct
    monkeypatch.setattr(SIRT, "reconstruct", lambda *given, **named: replace(
        found := whole(*given, **named), volume=found.volume / 0))
    row, other = ablate(tmp_path, phantoms=1, axes={"method": ["sirt", "cgls"], "method.iterations": [2]})
    assert row["status"] == "diverged" and "NaN or infinite" in row["error"] and "psnr" not in row
    assert other["status"] == "ok"


@pytest.mark.parametrize("owner, name", [(ReconstructionData, "simulate"), (Scoring, "scores")])
def test_what_goes_wrong_outside_the_method_is_tried_again(tmp_path, monkeypatch, capsys, trace, owner, name):
    def give_up(*_):
        raise ValueError("The case is damaged.")

    content = {"phantoms": 1, "axes": {"method": ["trace"]}}
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, give_up)
        said = refusal(capsys, main, arguments(tmp_path, **content))  # since no row is ok
    assert "none of the rows" in said and said.endswith("failed: The case is damaged.")
    (row,) = read_csv(tmp_path / "out" / "results.csv")
    assert (row["status"], row["error"]) == ("failed", "The case is damaged.")
    assert [row["status"] for row in ablate(tmp_path, **content)] == ["ok"]


@pytest.mark.parametrize("voxels", [None, 16])
def test_methods_without_a_prior_take_the_grid_and_window_of_those_with_one(tmp_path, capsys, voxels):
    save_prior(tiny_prior(False), tmp_path / "tiny.safetensors")
    specification = read_specification(write(
        tmp_path, base={"prior": str(tmp_path / "tiny.safetensors"), "voxels": voxels, "detector": 24},
        axes={"method": ["sirt", "phydict_fast"]}))
    sirt, fast = specification.trials
    planned(specification, Scoring(["volume"]))
    told = "methods without voxels of their own take the 16x16x16 of" in capsys.readouterr().err
    assert told == (voxels is None)
    assert sirt.scene()[0].shape == (16, 16, 16) and sirt.scene()[1] == fast.scene()[1] != HUWindow()
    assert sirt.acquisition() == fast.acquisition()


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


def test_a_geometry_file_is_an_axis_with_views_of_its_own(tmp_path, trace, plots):
    orbit = {"views": 2, "source_to_detector": 1020, "source_to_isocentre": 740, "shape": [24, 24], "pixel": 24}
    for name, change in {"tilted": {"tilt_degrees": 5}, "four": {"views": 4}}.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"orbit": orbit | change}))
    files = [str(tmp_path / f"{name}.yaml") for name in ("tilted", "four")]
    rows = ablate(tmp_path, base={"method": "trace", "voxels": 16}, axes={"geometry": files})
    assert [(Path(row["geometry"]).stem, row["views"]) for row in rows] == [("tilted", 2)] * 2 + [("four", 4)] * 2
    assert {len(xrays) for xrays, *_ in trace.given} == {2, 4}
    assert "by geometry" in (tmp_path / "out" / "tables.md").read_text()
    assert [file.name for file in (tmp_path / "out").glob("*.png")] == ["geometry.png"]


def test_the_table_of_another_comparison_is_left_alone(tmp_path, capsys, trace):
    ablate(tmp_path, phantoms=1, base=TINY, axes={"method": ["trace"]})
    before = {file: file.read_bytes() for file in (tmp_path / "out").iterdir()}
    other = write(tmp_path, phantoms=1, base=TINY | {"seed": 7}, axes={"method": ["trace"]})
    said = refusal(capsys, main, ["ablate", "-c", str(other)])
    assert "another out" in said and "(seed 0 there and 7 here)" in said
    assert {file: file.read_bytes() for file in (tmp_path / "out").iterdir()} == before
    for name in said.partition("or remove ")[2].split(", "):
        (tmp_path / "out" / name).unlink()
    main(["ablate", "-c", str(other), "--device", "cpu"])


@pytest.mark.parametrize("name", ["tables.md", "picture.png", "fid.csv"])
def test_what_other_programs_wrote_is_left_alone(tmp_path, capsys, trace, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    said = refusal(capsys, main, ["ablate", "-c", str(write(tmp_path, axes={"method": ["trace"]})), "--device", "cpu"])
    assert f"holds {name}, but no results.csv of this command" in said and not trace.given
    assert (tmp_path / "out" / name).read_text() == "mine"


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


def test_a_refined_rows_seconds_are_those_of_its_own_stages_and_its_precision_the_one_that_is_set(tmp_path):
    save_prior(tiny_prior(False), tmp_path / "tiny.safetensors")
    base = TINY | {"voxels": 32, "prior": str(tmp_path / "tiny.safetensors"), "method.iterations": 2}
    content = {"phantoms": 1, "base": base, "axes": {"method": ["phydict_fast"], "precision": ["float32", "bfloat16"]}}
    rows = ablate(tmp_path, **content)
    assert [row["precision"] for row in rows] == ["float32", "bfloat16"]
    for row in rows:
        stages = ("prepare", "base", "refine", "score")
        assert row["seconds"] == pytest.approx(sum(row[f"seconds_{stage}"] for stage in stages))
        assert 0 < row["seconds_base"] < row["seconds"] and "seconds_sample" not in row
    assert "phydict_fast, precision bfloat16" in (tmp_path / "out" / "tables.md").read_text()
    assert ablate(tmp_path, **content) == rows


def test_a_ct_that_has_changed_is_another_case_to_the_rows_of_its_earlier_state(tmp_path):
    (tmp_path / "cts").mkdir()

    def run(*methods: str, hu: int) -> list[dict]:
        volume = np.full((20, 20, 20), -1000, np.float32)
        volume[4:16, 6:15] = hu
        image = nibabel.Nifti1Image(volume, np.diag([10.0, 10, 10, 1]))
        image.set_sform(image.affine, code=1)
        nibabel.save(image, tmp_path / "cts" / "b.nii.gz")
        return ablate(tmp_path, cts=str(tmp_path / "cts"), phantoms=None, axes={"method": [*methods]})

    (old,) = run("cgls", hu=40)
    shutil.rmtree(tmp_path / "out")
    new = run("sirt", "cgls", hu=60)
    assert old["data"] != new[0]["data"] == new[1]["data"]
    table = tmp_path / "out" / "results.csv"
    mixed = [new[0], old]  # as where cgls was not run again
    older = [{name: value for name, value in row.items() if name != "data"} for row in mixed]
    for rows, marked in ((mixed, False), (new, True), (older, True)):
        write_csv(table, rows)
        main(["page", str(tmp_path / "out")])
        page = (tmp_path / "out" / "index.html").read_text()
        assert ('"place": 1' in page) == marked
        assert ("Of other data under one name, and so neither ranked nor paired: b, b (2)." in page) != marked


def test_a_ct_and_a_stored_volume_whose_names_are_no_text_are_compared(tmp_path):
    for folder in ("cts", "volumes"):
        save_ct(tmp_path / folder / os.fsdecode(b"caf\xe9.nii.gz"), thorax_hu())
    stored = {"of": "phydict.baselines.Stored", "method.folder": str(tmp_path / "volumes")}
    rows = ablate(tmp_path, cts=str(tmp_path / "cts"), phantoms=None, methods={"stored": stored},
                  axes={"method": ["cgls", "stored"]})
    assert [row["case"] for row in rows] == ["caf?", "caf?"] and rows[0]["status"] == "ok"


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


@pytest.mark.filterwarnings("always:.* is left out of the page")
def test_volumes_are_kept_where_that_is_asked_for_and_the_page_shows_them_in_their_place(tmp_path, trace, capsys):
    (tmp_path / "cts").mkdir()
    hu, affine = np.full((20, 20, 20), -1000, np.float32), np.diag([-10.0, 10, 10, 1])
    hu[4:16, 6:15], affine[:3, 3] = 40, (300, -90, 40)
    image = nibabel.Nifti1Image(hu, affine)
    image.set_sform(affine, code=1)
    nibabel.save(image, tmp_path / "cts" / "anna.nii.gz")
    content = {"cts": str(tmp_path / "cts"), "phantoms": None, "base": TINY, "axes": {"method": ["trace", "sirt"]}}
    out = tmp_path / "out"
    ablate(tmp_path, **content)
    assert not (out / "volumes").exists() and len(trace.given) == 2
    rows = ablate(tmp_path, "--keep_volumes", **content)
    assert len(trace.given) == 4  # a row without its volume is run again
    for row in rows:
        folder = out / "volumes" / row["key"]
        kept = nibabel.load(folder / "volume.nii.gz")
        assert kept.get_data_dtype() == np.int16 and kept.shape == (16, 16, 16)
        centre = kept.affine @ [7.5, 7.5, 7.5, 1]
        np.testing.assert_allclose(centre, affine @ [9.5, 9.5, 9.5, 1], atol=1e-3)
        assert {"view.js", "thumbnail.png", "volume.nii.gz", "details.json"} == {
            path.name for path in folder.iterdir()}
        details = json.loads((folder / "details.json").read_text())
        assert len(details["misfit_per_view"]) == row["views"] and details["settings"]["name"] == row["method"]
        assert '"truth"' in (folder / "view.js").read_text()
    page = (out / "index.html").read_text()
    assert all(f'"folder": "volumes/{row["key"]}"' in page for row in rows)
    assert ablate(tmp_path, "--keep_volumes", **content) == rows == ablate(tmp_path, **content)
    assert len(trace.given) == 4
    for damage in ('{"misfit_per_view": [', "[1, 2]", ""):
        (out / "volumes" / rows[0]["key"] / "details.json").write_text(damage)
        main(["page", str(out)])
        assert f"{rows[0]['key']}/details.json is left out of the page" in capsys.readouterr().err
        assert all(row["key"] in (out / "index.html").read_text() for row in rows)
    shown = out / "volumes" / rows[0]["key"] / "view.js"
    shown.unlink()
    main(["page", str(out)])  # of the volume alone
    assert shown.is_file() and '"truth"' not in shown.read_text()


def test_a_page_made_anew_shows_of_each_case_the_row_of_the_last_run(tmp_path, capsys):
    files = [tmp_path / f"{name}.yaml" for name in "ab"]
    content = {"base": {"voxels": 16}, "axes": {"method": ["trace", "sirt"], "method.iterations": [2],
                                                "geometry": [str(file) for file in files]}}
    out, orbit = tmp_path / "out", {"views": 2, "source_to_detector": 1020, "source_to_isocentre": 740,
                                    "shape": [24, 24], "pixel": 24}
    for tilt in (0, 8):
        for file, degrees in zip(files, (0, tilt)):
            file.write_text(yaml.safe_dump({"orbit": orbit | {"tilt_degrees": degrees}}))
        rows = ablate(tmp_path, **content)
    assert len(rows) == 12 and len({row["key"] for row in rows}) == 12
    capsys.readouterr()
    for remake in (lambda: None, lambda: main(["page", str(out)])):
        remake()
        page = (out / "index.html").read_text()
        assert [row["key"] in page for row in rows] == [True] * 8 + [False] * 4
    assert "4 of the 12 rows in" in "".join(capsys.readouterr())


def test_rows_that_lack_their_volume_stay_until_they_are_replaced(tmp_path, monkeypatch, trace):
    content = {"phantoms": 1, "base": TINY, "axes": {"method": ["trace", "sirt"]}}
    rows = ablate(tmp_path, **content)

    def give_up(calls):
        raise ValueError("no")

    monkeypatch.setattr(trace, "behave", staticmethod(give_up))
    again = ablate(tmp_path, "--keep_volumes", **content)
    assert again[0] == rows[0] and again[1]["psnr"] == rows[1]["psnr"]
    assert not (tmp_path / "out" / "volumes" / rows[0]["key"]).exists()


def test_results_are_never_written_among_the_cts(tmp_path, capsys):
    cts = tmp_path / "cts"
    cts.mkdir()
    nibabel.save(nibabel.Nifti1Image(np.zeros((20, 20, 20), np.float32), np.diag([10.0, 10, 10, 1])), cts / "a.nii.gz")
    for out in (cts, cts / "out"):
        file = write(tmp_path, axes={"method": ["trace"]}, cts=str(cts), out=str(out), phantoms=None)
        assert "give another out" in refusal(capsys, main, ["ablate", "-c", str(file), "--device", "cpu"])
    assert [path.name for path in cts.iterdir()] == ["a.nii.gz"]


def test_no_other_run_comes_in_before_tables_and_page_are_written(tmp_path, monkeypatch, trace):
    met = []

    def meanwhile(writing):
        def written(out, *more):
            with pytest.raises(ValueError, match="another run"), alone_in(out, "out"):
                pass
            met.append(writing.__name__)
            return writing(out, *more)
        return written

    for writing in (command.write_distances, command.write_tables, command.comparison_page):
        monkeypatch.setattr(command, writing.__name__, meanwhile(writing))
    ablate(tmp_path, axes={"method": ["trace"]})
    assert met == ["write_distances", "write_tables", "comparison_page"]


def test_a_device_that_is_not_there_is_refused(tmp_path, capsys):
    file = write(tmp_path, axes={"method": ["trace"]})
    assert "--device warp cannot be used" in refusal(capsys, main, ["ablate", "-c", str(file), "--device", "warp"])


def test_a_table_with_words_for_numbers_is_refused_by_row_and_column(tmp_path, capsys):
    (row, *_) = ablate(tmp_path, axes={"method": ["trace"]})
    table = tmp_path / "out" / "results.csv"
    table.write_text(table.read_text().replace(repr(row["psnr"]), "1e999"))
    said = refusal(capsys, main, ["ablate", "-c", str(tmp_path / "spec.yaml"), "--device", "cpu"])
    assert f"psnr of row {row['key']} is '1e999'" in said and "results.csv" in said


def test_what_a_row_is_to_keep_and_cannot_ends_the_run(tmp_path, monkeypatch, capsys, trace):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    content = {"phantoms": 1, "axes": {"method": ["trace", "sirt"]}}
    with monkeypatch.context() as patch:
        patch.setattr("phydict.ablation.run.save_nifti", full)
        said = refusal(capsys, main, [*arguments(tmp_path, **content), "--keep_volumes"])
    assert "free some space" in said and not (tmp_path / "out" / "results.csv").exists()
    assert {row["status"] for row in ablate(tmp_path, "--keep_volumes", **content)} == {"ok"}


def test_what_a_killed_run_had_begun_to_keep_is_removed(tmp_path, trace):
    begun = [tmp_path / "out" / "volumes" / f".k1.{machine()}.99999999.partial",
             tmp_path / "out" / "features" / f".{machine()}.99999999.part.k1.safetensors"]
    for folder in begun:
        folder.parent.mkdir(parents=True)
    begun[0].mkdir()
    begun[1].touch()
    ablate(tmp_path, phantoms=1, axes={"method": ["trace"]})
    assert not any(path.exists() for path in begun)


def test_plots_of_an_earlier_run_make_way_for_those_of_this_one(tmp_path, trace, plots):
    axes = {"method": ["trace", "sirt"], "method.iterations": [2]}
    ablate(tmp_path, phantoms=1, axes=axes | {"views": [2]})
    assert (tmp_path / "out" / "pareto.png").exists()
    (tmp_path / "out" / "mine.png").touch()
    ablate(tmp_path, phantoms=1, axes=axes | {"views": [2, 3]})
    assert {path.stem for path in (tmp_path / "out").glob("*.png")} == {
        "mine", "views", *(f"{kind}_K_{views}" for kind in ("pareto", "stages") for views in (2, 3))}


@dataclass(frozen=True)
class Weighted(Trace):
    """A method with settings that are a list and a mapping."""

    weights: list[float] = field(default_factory=list)
    named: dict[str, float] = field(default_factory=dict)


def test_a_list_or_a_mapping_is_a_setting_as_others_are(tmp_path):
    path = f"{Weighted.__module__}.{Weighted.__qualname__}"
    axes = {"method.weights": [[1.0, 2.0], [3.0]], "method.named": [{"a": 1.0}, {}]}
    rows = ablate(tmp_path, phantoms=1, methods={"own": {"of": path}}, axes=axes)
    assert [(row["method.named"], row["method.weights"]) for row in rows] == [
        ('{"a": 1.0}', "[1.0, 2.0]"), ('{"a": 1.0}', "[3.0]"), ("{}", "[1.0, 2.0]"), ("{}", "[3.0]")]
    assert "own, named {}, weights [3.0]" in (tmp_path / "out" / "tables.md").read_text()
