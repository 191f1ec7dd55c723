"""Finished cases on disk: kept, resumed, and never lost or half-written."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from processes import INFER, Python

from inference.runs import FILES, ORBIT, ROOT, contents, names, phantoms, record, sirt, stamp, volume, with_prior, xrays
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import load_xrays
from phydict.grid import Grid
from phydict.methods import reconstruct
from phydict.reconstruction import save_nifti
from phydict.runtime.files import machine
from phydict.xray import ConeBeam


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_finished_case_is_kept_until_asked_otherwise(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    folder = tmp_path / "sirt" / "anna"
    main(args)
    before = stamp(folder)
    main(args)
    assert stamp(folder) == before and "1 of 1 cases are finished already" in capsys.readouterr().err
    main([*args, "--profile"])
    assert "not profiled: --model.overwrite true" in capsys.readouterr().err
    for change in ("--model.seed=1", "--model.method.init_args.iterations=4", "--data.geometry=arc_90"):
        said = refusal(capsys, main, [*args, change])
        assert "other settings" in said and "overwrite" in said
    assert stamp(folder) == before
    main([*args, "--model.overwrite=true", "--model.seed=1"])
    assert all(stamp(folder)[name] > before[name] for name in FILES) and record(folder)["settings"]["seed"] == 1


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_a_stopped_run_goes_on_where_it_was(measured, tmp_path, monkeypatch, stop):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    calls, whole = [], SIRT.reconstruct

    def stopping(self, *given):
        calls.append(given)
        if len(calls) == 2:
            raise stop
        return whole(self, *given)

    monkeypatch.setattr(SIRT, "reconstruct", stopping)
    with pytest.raises(SystemExit if stop is KeyboardInterrupt else stop):
        main(args)
    assert names(tmp_path / "sirt") == ["anna"]
    before = stamp(tmp_path / "sirt" / "anna")
    main(args)
    assert stamp(tmp_path / "sirt" / "anna") == before and len(calls) == 3
    assert all(f'"folder": "sirt/{case}"' in (tmp_path / "index.html").read_text() for case in ("anna", "bert"))
    assert names(tmp_path / "sirt" / "bert") == FILES


def test_a_partial_folder_is_never_a_finished_case(measured, scored, tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for process in (gone.pid, os.getpid()):  # killed while it wrote, and writing now
        partial = tmp_path / "sirt" / f".anna.{machine()}.{process}.partial"
        partial.mkdir(parents=True)
        for name in ("volume.nii.gz", "coarse.nii.gz"):
            (partial / name).write_bytes(b"half")
    main(sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}"))
    assert names(tmp_path / "sirt" / "anna") == FILES and volume(tmp_path / "sirt" / "anna").shape == (64, 64, 64)
    assert names(tmp_path / "sirt") == ["anna"]


@pytest.mark.parametrize("overwrite", ["false", "true"])
def test_a_folder_that_is_no_case_is_never_replaced(measured, tmp_path, capsys, overwrite):
    notes = tmp_path / "sirt" / "anna" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("mine")
    said = refusal(capsys, main, sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}",
                                f"--model.overwrite={overwrite}"))
    assert str(notes.parent) in said and "model.out" in said and "overwrite" not in said
    assert names(tmp_path / "sirt") == ["anna"] and notes.read_text() == "mine"


def test_results_are_never_written_among_the_cts(cts, tmp_path, capsys):
    before = contents(cts)
    said = refusal(capsys, main, sirt("test", cts, f"--data.cts={cts}", *ORBIT))
    assert "lies inside the input" in said and contents(cts) == before


def test_a_geometry_whose_name_is_no_utf_8_is_named_in_the_tables_all_the_same(tmp_path):
    file = shutil.copy(ROOT / "configs" / "geometry" / "biplanar.yaml", tmp_path / os.fsdecode(b"caf\xe9.yaml"))
    main(sirt("test", tmp_path / "out", "--data.cts=phantom", "--data.phantoms=1", "--model.grid=16",
              f"--data.geometry={file}"))
    assert "geometry caf?.yaml" in (tmp_path / "out" / "sirt" / "results.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["../other", "/{out}/other", "a/b", "..", ".", ".x", "", "caf\udce9"])
def test_a_name_is_that_of_one_folder_inside_the_output(measured, tmp_path, capsys, name):
    name = name.format(out=str(tmp_path).strip("/"))
    said = refusal(capsys, main, sirt("predict", tmp_path / "out", f"--data.xrays={measured}", f"--model.name={name}"))
    assert f"one folder inside model.out, but {name!r} was given" in said and names(tmp_path) == []


@pytest.mark.filterwarnings("default")
def test_a_coarse_volume_that_is_to_be_kept_is_made_where_a_finished_case_lacks_it(measured, prior, tmp_path, capsys):
    args = with_prior("predict", tmp_path, prior, f"--data.xrays={measured / 'anna'}", "--model.grid=24")
    folder, keep = tmp_path / "prior_only" / "anna", "--model.grid.keep_coarse=true"
    main(args)
    main([*args, keep])
    assert (folder / "coarse.nii.gz").is_file() and "finished already" not in capsys.readouterr().err
    before = stamp(folder)
    for again in (args, [*args, keep]):
        main(again)
    assert stamp(folder) == before
    (folder / "coarse.nii.gz").unlink()
    (folder / "notes.txt").write_text("mine")
    assert "notes.txt" in refusal(capsys, main, [*args, keep]) and stamp(folder) == before


@pytest.mark.filterwarnings("default")
def test_a_finished_case_is_kept_where_no_coarse_volume_was_made(measured, tmp_path):
    small = xrays(tmp_path / "small", ConeBeam.orbit(3, 600.0, 300.0, (24, 24), 2.5))
    for case, box in ((measured / "anna", ["--model.grid=32"]), (small, ["--model.grid=16", "--model.grid.side=60"])):
        args = sirt("predict", tmp_path / "out", f"--data.xrays={case}", *box)
        main(args)
        before = stamp(tmp_path / "out" / "sirt" / case.name)
        main([*args, "--model.grid.keep_coarse=true"])
        assert stamp(tmp_path / "out" / "sirt" / case.name) == before


@pytest.mark.parametrize("several", [False, True])
def test_a_result_stays_when_its_redo_fails(measured, tmp_path, capsys, several):
    shutil.copytree(measured if several else measured / "anna", tmp_path / "anna" if not several else tmp_path / "in")
    given = tmp_path / ("in" if several else "anna")
    args = sirt("predict", tmp_path / "out", f"--data.xrays={given}")
    main(args)
    folder = tmp_path / "out" / "sirt" / "anna"
    before = stamp(folder)
    image = (given / "anna" if several else given) / "view_1.npy"
    image.write_bytes(image.read_bytes()[:200])
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main([*args, "--model.overwrite=true"])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and "view_1.npy" in said and stamp(folder) == before
    assert ("1 of 2 cases were not reconstructed (anna)" in said) == several


@pytest.mark.parametrize("seed, code", [(0, None), (1, 2)], ids=["same settings", "other settings"])
def test_a_run_that_another_one_overtakes_keeps_its_result(measured, tmp_path, capsys, monkeypatch, seed, code):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    folder, whole = tmp_path / "sirt" / "anna", SIRT.reconstruct
    overtaken = []

    def slow(self, *given):
        found = whole(self, *given)
        if not overtaken:
            overtaken.append(True)
            main([*args, f"--model.seed={seed}"])
            overtaken.append(stamp(folder))
        return found

    monkeypatch.setattr(SIRT, "reconstruct", slow)
    if code is None:
        main(args)
    else:
        assert "another process has finished" in refusal(capsys, main, args)
    assert stamp(folder) == overtaken[1] and record(folder)["settings"]["seed"] == seed


def test_a_result_that_cannot_be_written_leaves_nothing_beside(measured, tmp_path):
    case = load_xrays(measured / "anna")
    found = reconstruct(case["xrays"], case["beam"], method=SIRT(iterations=1))
    found.save_nifti(tmp_path / "volume.nii.gz")
    before = contents(tmp_path)
    with largest_file(1000), pytest.raises(OSError):
        found.save_nifti(tmp_path / "volume.nii.gz")
    assert contents(tmp_path) == before


def test_a_damaged_record_is_named(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured / 'anna'}")
    main(args)
    file = tmp_path / "sirt" / "anna" / "reconstruction.json"
    for content in (file.read_text()[:50], "{}"):
        file.write_text(content)
        said = refusal(capsys, main, args)
        assert str(file.parent) in said and "damaged" in said


def test_a_finished_case_is_never_taken_for_that_of_other_data(measured, cts, tmp_path, capsys):
    shutil.copytree(measured / "anna", tmp_path / "case")
    xrays, ct = (sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'case'}"),
                 sirt("test", tmp_path / "out", f"--data.cts={tmp_path / 'ct.nii.gz'}", *ORBIT))
    main(xrays)
    for file in sorted((tmp_path / "case").iterdir()):
        whole = file.read_bytes()
        file.write_bytes(whole + b"\n")
        assert "other data" in refusal(capsys, main, xrays), file
        file.write_bytes(whole)
    main(xrays)
    for name in ("a", "b"):
        shutil.copyfile(cts / f"{name}.nii.gz", tmp_path / "ct.nii.gz")
        if name == "a":
            main(ct)
            shutil.copyfile(cts / "a.nii.gz", tmp_path / "ct.nii.gz")  # later, but the same
            main(ct)
    assert "other data" in refusal(capsys, main, ct)


def test_what_a_geometry_file_names_elsewhere_is_data_too(measured, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(measured / "anna", tmp_path / "case")
    (tmp_path / "case" / "geometry.yaml").rename(tmp_path / "beam.yaml")
    content = yaml.safe_load((tmp_path / "beam.yaml").read_text())
    (tmp_path / "beam.yaml").write_text(yaml.safe_dump({"beam": content["beam"]}))
    shape = load_xrays(measured / "anna")["xrays"].shape[1:]
    np.save(tmp_path / "flat.npy", np.full(shape, 100.0, np.float32))
    (tmp_path / "g.yaml").write_text("beam: {file: beam.yaml}\nintensity: {kind: counts, flat: flat.npy}\n")
    for view in (tmp_path / "case").glob("*.npy"):
        np.save(view, 100 * np.exp(-np.load(view)))
    xrays = sirt("predict", tmp_path / "out", "--data.xrays=case", "--data.geometry=g.yaml")
    main(xrays)
    main([*xrays[:-1], "--data.geometry=./g.yaml"])
    assert "kept" in capsys.readouterr().err
    for file in ("beam.yaml", "flat.npy", "g.yaml"):
        whole = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(whole + b"\n")
        assert "other data" in refusal(capsys, main, xrays), file
        (tmp_path / file).write_bytes(whole)


def test_one_bad_case_spoils_no_other(measured, tmp_path, capsys):
    shutil.copytree(measured, tmp_path / "cases")
    next(path for path in (tmp_path / "cases" / "anna").iterdir() if path.suffix not in (".yaml", ".txt")).unlink()
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(sirt("predict", tmp_path / "out", f"--data.xrays={tmp_path / 'cases'}"))
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and len(said) == 2
    assert said[0].startswith("error: anna: ") and "1 of 2 cases were not reconstructed (anna)" in said[1]
    assert names(tmp_path / "out" / "sirt") == ["bert"] and names(tmp_path / "out" / "sirt" / "bert") == FILES


def test_a_case_without_a_volume_of_another_program_spoils_no_other(measured, tmp_path, capsys):
    (tmp_path / "elsewhere" / "bert").mkdir(parents=True)
    save_nifti(tmp_path / "elsewhere" / "bert" / "volume.nii.gz", np.full((8, 8, 8), -1000), Grid.cube(8))
    with pytest.raises(SystemExit) as stopped:
        main(["predict", f"--data.xrays={measured}", "--model.method=phydict.baselines.Stored", "--model.grid=8",
              f"--model.method.init_args.folder={tmp_path / 'elsewhere'}", f"--model.out={tmp_path / 'out'}"])
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and said[0].startswith("error: anna: there is no volume of anna in ")
    assert "1 of 2 cases were not reconstructed (anna)" in said[1]
    assert names(tmp_path / "out" / "Stored") == ["bert"] and (tmp_path / "out" / "index.html").is_file()


def test_a_case_that_memory_gives_out_for_spoils_no_other(measured, tmp_path, capsys, monkeypatch):
    calls, whole = [], SIRT.reconstruct

    def large_at_first(self, *given):
        calls.append(given)
        return torch.empty(2**50) if len(calls) == 1 else whole(self, *given)

    monkeypatch.setattr(SIRT, "reconstruct", large_at_first)
    with pytest.raises(SystemExit) as stopped:
        main(sirt("predict", tmp_path, f"--data.xrays={measured}"))
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert stopped.value.code == 2 and said[0].startswith("error: anna: memory gave out (")
    assert "1 of 2 cases were not reconstructed (anna)" in said[1] and names(tmp_path / "sirt") == ["bert"]


def test_a_signal_ends_the_run_between_cases_and_is_no_success(tmp_path):
    args = phantoms(tmp_path, 200)
    run = Python(INFER, *args)
    run.wait_for(lambda: "misfit" in run.err)
    run.process.terminate()
    assert run.wait(60) == 143 and "run the same command again" in run.err
    done = names(tmp_path / "sirt")
    assert 1 <= len(done) < 200 and all(names(tmp_path / "sirt" / case) == FILES for case in done)


def test_a_disk_that_fills_up_leaves_no_case_that_looks_finished(measured, tmp_path, capsys):
    args = sirt("predict", tmp_path, f"--data.xrays={measured}")
    with largest_file(50_000):
        said = refusal(capsys, main, args)
    assert "anna" in said and "could not be written" in said and "free some space" not in said  # the disk is not full
    assert names(tmp_path / "sirt") == []
    main(args)
    assert names(tmp_path / "sirt") == ["anna", "bert"]
