"""What a long run tells: what is done, what remains and for how long, in words or for machines, or nothing."""

import json
import re
from io import StringIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console

from phydict.evaluation.fid import distances, fid_rows
from phydict.evaluation.planes import PLANES
from phydict.inference.distances import distance_rows
from phydict.inference.scoring import FIDSettings
from phydict.runtime import progress as module
from phydict.runtime.progress import CaseProgress, duration
from phydict.runtime.progress_log import bars_on, log_progress, progress_as
from phydict.training import progress as training_progress
from phydict.training.progress import TrainingProgress


@pytest.fixture
def told(capsys, monkeypatch):
    """The lines of a run over three cases of two steps, each case 40 s long."""
    def run(quiet: bool = False, json_lines: bool = False) -> list[str]:
        now = [0.0]
        monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
        with progress_as(quiet, json_lines), CaseProgress(interval=10) as progress:
            progress.begin("sirt", 3, 2, out="there")
            for case in "abc":
                progress.case(case)
                for _ in range(2):
                    now[0] += 20
                    progress.advance()
                progress.finished("good")
        return capsys.readouterr().err.splitlines()
    return run


def test_a_log_says_what_is_done_what_remains_for_how_long_and_where(told):
    assert told() == ["sirt: 3 cases to reconstruct, results in there",
                      "a: step 1 of 2, about 2 min to go", "a: step 2 of 2, about 80 s to go",
                      "a: good (1 of 3, about 80 s to go)",
                      "b: step 1 of 2, about 60 s to go", "b: step 2 of 2, about 40 s to go",
                      "b: good (2 of 3, about 40 s to go)",
                      "c: step 1 of 2, about 20 s to go", "c: step 2 of 2", "c: good (3 of 3)"]


def test_on_a_narrow_terminal_a_long_name_is_cut_and_counts_and_times_are_whole():
    console = Console(width=80, file=StringIO())
    bars = bars_on(console)
    for name, done in (("phantom 100000, phydict_learned, views 16, [/b] simulator polychromatic", 17), ("sirt", 3)):
        bars.add_task(name, total=1234, completed=done)
    console.print(bars.make_tasks_table(bars.tasks))
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 2 and "…" in lines[0] and lines[1].startswith("sirt ")
    assert all(f" {done:>4}/1234 0:00:00 so far, -:--:-- to go" in line for done, line in zip((17, 3), lines))


def test_a_case_may_have_steps_of_its_own(capsys, monkeypatch):
    now = iter(range(0, 1000, 20))
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(now)))
    with progress_as(False, False), CaseProgress(interval=10) as progress:
        progress.begin("ablate", 1, verb="run", noun="row")
        progress.case("fast")
        progress.advance()  # of a run that warms up
        progress.follow(4)
        progress.advance()
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "ablate: 1 row to run", "fast: step 1", "fast: step 1 of 4"]


def test_machines_read_the_same_as_json(told):
    begin, *events = map(json.loads, told(json_lines=True))
    assert begin == {"event": "begin", "name": "sirt", "cases": 3, "steps": 2, "out": "there"}
    cases = [event for event in events if event["event"] == "case"]
    assert [(e["case"], e["done"], e["cases"], e["seconds_to_go"]) for e in cases] == [
        ("a", 1, 3, 80.0), ("b", 2, 3, 40.0), ("c", 3, 3, 0.0)]


def test_machines_read_null_for_what_is_no_finite_number(capsys):
    with progress_as(False, True):
        log_progress("scored", psnr=float("inf"), scores={"ssim": float("nan"), "views": [1, 0.5]})
    line = json.loads(capsys.readouterr().err, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert line == {"psnr": None, "scores": {"ssim": None, "views": [1, 0.5]}}


def test_quiet_tells_nothing(told):
    assert told(quiet=True) == [] == told(quiet=True, json_lines=True)


def test_a_long_validation_of_a_training_tells_its_cases(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(training_progress.time, "monotonic", lambda: now[0])
    trainer = SimpleNamespace(state=SimpleNamespace(fn="fit"), sanity_checking=False, num_val_batches=[4],
                              is_global_zero=True)
    for bar_is_shown, lines in ((False, ["validation: 2 of 4 cases", "validation: 4 of 4 cases"]), (True, [])):
        progress = TrainingProgress(interval=10)
        progress.spoke, progress.bar = now[0], SimpleNamespace(disable=not bar_is_shown)
        for index in range(4):
            now[0] += 6
            progress.on_validation_batch_end(trainer, None, None, None, index)
        assert capsys.readouterr().err.splitlines() == lines


def test_frechet_distances_tell_plane_after_plane_and_are_the_same(capsys):
    some = np.random.default_rng(0)
    methods = {method: {case: {plane: torch.from_numpy(some.normal(size=(2, 5, 3))) for plane in PLANES}
                        for case in cases} for method, cases in (("sirt", "ab"), ("tv", "ab"), ("fdk", "a"))}
    fid = FIDSettings(replicates=7)
    assert distance_rows(methods, fid) == fid_rows(distances(methods, 7), fid.backbone, 7, fid.normalisation)
    begin, *lines = capsys.readouterr().err.splitlines()
    assert begin == "Frechet distances of slices: 6 planes to measure"  # of two groups of methods with the same cases
    assert [re.sub(", about .* to go", "", line) for line in lines] == [
        f"plane {plane}: measured ({n} of 6)" for n, plane in enumerate([*PLANES, *PLANES], 1)]


@pytest.mark.parametrize("seconds, words", [(0.4, "0 s"), (99, "99 s"), (100, "2 min"), (5900, "98 min"),
                                            (12000, "3 h 20 min")])
def test_a_duration_is_in_words(seconds, words):
    assert duration(seconds) == words
