"""Finished cases on disk: none is lost, whoever fails, is killed, or writes at the same time."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from phydict.evaluation import read_csv
from phydict.inference.results import RECORD, RESULTS, CaseResults
from phydict.runtime.files import ASIDE

SETTINGS = {"seed": 0}


def record(settings: dict = SETTINGS, source: str = "crc32 1") -> dict:
    return {"settings": settings, "source": source, "scores": None, "misfit": float("nan")}


def fill(folder: Path, content: str = "old") -> None:
    for name in ("volume.nii.gz", "panel.png"):
        (folder / name).write_text(content)


def begun(folder: Path, overwrite: bool = False, settings: dict = SETTINGS) -> CaseResults:
    """The results of a run that has looked which cases are left."""
    results = CaseResults(folder, overwrite)
    results.unfinished({"anna": "crc32 1"}, settings)
    return results


def finish(results: CaseResults, content: str, settings: dict = SETTINGS) -> None:
    results.write("anna", record(settings), lambda folder: fill(folder, content))


@pytest.fixture
def old(tmp_path) -> Path:
    """The folder of a finished case."""
    finish(begun(tmp_path), "old")
    return tmp_path / "anna"


def held(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_record_lists_the_files_of_its_case(old):
    assert json.loads((old / RECORD).read_text())["files"] == ["panel.png", "volume.nii.gz"]


def test_an_older_record_without_a_list_is_read_and_its_case_replaced_if_nothing_else_is_there(old):
    (old / RECORD).write_text(json.dumps(record()))
    assert CaseResults(old.parent).unfinished({"anna": "crc32 1"}, SETTINGS) == []
    (old / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds notes.txt, which phydict did not write, and is not replaced"):
        begun(old.parent, overwrite=True)
    (old / "notes.txt").unlink()
    finish(begun(old.parent, overwrite=True), "new")
    assert held(old)["volume.nii.gz"] == "new"


def test_a_folder_that_has_the_name_of_a_file_is_not_replaced_with_what_is_in_it(old):
    (old / "panel.png").unlink()
    (old / "panel.png").mkdir()
    (old / "panel.png" / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds panel.png, which phydict did not write, and is not replaced"):
        begun(old.parent, overwrite=True)
    assert (old / "panel.png" / "mine.txt").read_text() == "mine"


def notes_beside(old: Path) -> None:
    (old / "notes.txt").write_text("mine")


def a_file(old: Path) -> None:
    for path in old.iterdir():
        path.unlink()
    old.rmdir()
    old.write_text("mine")


def a_link(old: Path) -> None:
    old.rename(old.with_name("elsewhere"))
    old.symlink_to(old.with_name("elsewhere"))


@pytest.mark.parametrize("change", [
    notes_beside, a_file, a_link, lambda old: (old / RECORD).unlink(), lambda old: (old / RECORD).write_text("{}"),
    lambda old: (old / RECORD).write_text("[]"), lambda old: (old / RECORD).write_text(json.dumps(record())[:30]),
    lambda old: (old / RECORD).write_text(json.dumps(record() | {"files": 3}))])
@pytest.mark.parametrize("when", ["at the start", "when a result takes its place"])
def test_what_no_reconstruction_wrote_is_never_replaced(old, change, when):
    if when == "at the start":
        change(old)
        before = old.read_text() if old.is_file() else held(old)
        with pytest.raises(ValueError, match="is not replaced.*move .* away, or give another model.out"):
            begun(old.parent, overwrite=True)
    else:
        results = begun(old.parent, overwrite=True)
        change(old)
        before = old.read_text() if old.is_file() else held(old)
        with pytest.raises(ValueError, match="is not replaced"):
            finish(results, "new")
    assert (old.read_text() if old.is_file() else held(old)) == before
    assert not any(path.name.startswith(".") for path in old.parent.iterdir())


def test_a_result_stays_until_the_new_one_is_complete(old):
    results, before = begun(old.parent, overwrite=True), held(old)

    def fail(folder: Path) -> None:
        fill(folder, "half")
        raise ValueError("the X-rays are truncated")

    with pytest.raises(ValueError, match="truncated"):
        results.write("anna", record(), fail)
    assert held(old) == before and [path.name for path in old.parent.iterdir()] == ["anna"]
    assert results.missing() == ["anna"]
    finish(results, "new")
    assert held(old)["volume.nii.gz"] == "new" and results.missing() == []


@pytest.mark.parametrize("overwrite", [False, True])
def test_of_two_runs_with_other_settings_the_second_to_end_is_refused(tmp_path, overwrite):
    if overwrite:
        finish(begun(tmp_path, settings={"seed": 5}), "old", {"seed": 5})
    first, second = (begun(tmp_path, overwrite, {"seed": seed}) for seed in (0, 1))
    finish(first, "first", {"seed": 0})
    with pytest.raises(ValueError, match="another process has finished .* with other settings in the meantime"):
        finish(second, "second", {"seed": 1})
    assert held(tmp_path / "anna")["volume.nii.gz"] == "first"
    assert first.missing() == [] and second.missing() == ["anna"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_of_two_runs_with_the_same_settings_both_have_finished(tmp_path, overwrite):
    if overwrite:
        finish(begun(tmp_path), "old")
    first, second = (begun(tmp_path, overwrite) for _ in range(2))
    finish(first, "first")
    finish(second, "second")
    assert held(tmp_path / "anna")["volume.nii.gz"] == "first" and first.missing() == second.missing() == []


def in_another_process(work: Callable, *args: object) -> multiprocessing.Process:
    process = multiprocessing.get_context("fork").Process(target=work, args=args)
    process.start()
    return process


def finish_again_and_again(folder: Path) -> None:
    for _ in range(50):
        finish(begun(folder, overwrite=True), "new")


def test_a_case_is_there_at_every_moment_while_two_processes_replace_it(old):
    writers = [in_another_process(finish_again_and_again, old.parent) for _ in range(2)]
    while any(writer.is_alive() for writer in writers):
        assert CaseResults(old.parent).unfinished({"anna": "crc32 1"}, SETTINGS) == []
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert held(old)["volume.nii.gz"] == "new" and [path.name for path in old.parent.iterdir()] == ["anna"]


def finish_until(folder: Path, name: str) -> None:
    """Is killed as soon as a folder has been renamed to `name`."""
    results, rename = begun(folder, overwrite=True), Path.rename

    def fatal_rename(path: Path, target: Path) -> None:
        rename(path, target)
        if target.name == name:
            os.kill(os.getpid(), signal.SIGKILL)

    Path.rename = fatal_rename
    finish(results, "new")


@pytest.mark.parametrize("name, content", [(f".anna{ASIDE}", "old"), ("anna", "new")],
                         ids=["nothing in its place", "the old one aside"])
def test_a_kill_between_the_steps_of_taking_a_place_loses_no_case(old, name, content):
    killed = in_another_process(finish_until, old.parent, name)
    killed.join(60)
    assert killed.exitcode == -signal.SIGKILL
    assert len(list(old.parent.iterdir())) == 2  # it was killed in between
    assert CaseResults(old.parent).unfinished({"anna": "crc32 1"}, SETTINGS) == []
    assert [path.name for path in old.parent.iterdir()] == ["anna"]
    assert held(old)["volume.nii.gz"] == held(old)["panel.png"] == content


@pytest.mark.parametrize("name", ["results.csv", "results.md"])
def test_a_table_of_someone_elses_is_never_replaced(tmp_path, name):
    (tmp_path / name).write_text("patient,result\n")
    with pytest.raises(ValueError, match=f"{name} is no table of this command, and is not replaced"):
        begun(tmp_path)


SCORED = record() | {"method": "sirt", "views": 3, "grid": {"shape": [4, 4, 4]}, "scores": {"psnr": 20.0},
                     "seconds": {"all": 1.0}, "network_calls": 0, "projector_calls": 2, "files": ["volume.nii.gz"]}


@pytest.mark.parametrize("damage", [
    *({name: ...} for name in ("method", "views", "grid", "seconds", "network_calls")), {"scores": "good"},
    {"scores": {"psnr": [1]}}, {"seconds": 3}, {"method": ["sirt"]}, {"grid": []}, "[" * 100_000, "[]", "9" * 5000],
    ids=repr)
def test_a_damaged_record_is_refused_by_name_before_anything_is_done(old, damage):
    whole = json.dumps({k: v for k, v in (SCORED | damage).items() if v is not ...}) if isinstance(damage,
    dict) else damage
    (old / RECORD).write_text(whole)
    with pytest.raises(ValueError, match=f"{old} is in the place of a case, but its {RECORD} is missing or damaged"):
        begun(old.parent)


def test_a_whole_record_gives_its_row(old):
    (old / RECORD).write_text(json.dumps(SCORED))
    assert len(begun(old.parent).summarise(["anna"])) == 1
    assert read_csv(old.parent / RESULTS)[0]["psnr"] == 20.0


@pytest.mark.parametrize("setting", [float("inf"), float("nan")])
def test_a_case_of_settings_that_are_no_finite_number_is_finished(tmp_path, setting):
    settings = {"seed": 0, "prior": {"cap": setting}}
    finish(results := begun(tmp_path, settings=settings), "old", settings)
    assert results.missing() == [] and CaseResults(tmp_path).unfinished({"anna": "crc32 1"}, settings) == []
