"""What Windows lacks is never asked for; `mypy --platform win32`, part of `make lint`, looks for more of it."""

from __future__ import annotations

import math
import os
import select
import signal
import sys

import numpy as np
import pytest

from inference.runs import names, record, sirt, volume
from phydict.cli.infer import main
from phydict.datasets.cts import preparation
from phydict.runtime import console, files, memory, profiling
from phydict.runtime.memory import check_memory, free_memory

LACKING = ((files, "fcntl"), (profiling, "resource"), (os, "register_at_fork"), (os, "sysconf"), (select, "poll"),
           (signal, "pthread_sigmask"), (signal, "pthread_kill"))


class WindowsSys:
    """What phydict is shown as `sys`; other libraries still see this machine's."""

    platform = "win32"

    def __getattr__(self, name: str):
        return getattr(sys, name)


@pytest.fixture
def on_windows(monkeypatch, tmp_path):
    """Takes away what Windows has not got."""
    for module in (files, profiling, memory, console, preparation):
        monkeypatch.setattr(module, "sys", WindowsSys())
    for module, name in LACKING:
        monkeypatch.delattr(module, name)
    begin, send = os.open, os.kill

    def opened(path, *how, **more):
        if os.path.isdir(path) and sys._getframe(1).f_globals["__name__"].startswith("phydict"):
            raise PermissionError(13, "Permission denied", path)
        return begin(path, *how, **more)

    def sent(process, number):
        assert number, "0 is Ctrl-C there"
        send(process, number)

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(os, "kill", sent)
    for name in ("MEMINFO", "STATM"):
        monkeypatch.setattr(f"phydict.runtime.memory.{name}", tmp_path / "none")
    monkeypatch.setattr(profiling, "Path", lambda file: tmp_path / "none" / file.lstrip("/"))


def test_cases_are_reconstructed_scored_and_kept(on_windows, measured, tmp_path):
    main(sirt("predict", tmp_path, f"--data.xrays={measured}"))
    when = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("volume.nii.gz")}
    folder = tmp_path / "sirt" / "anna"
    assert names(tmp_path / "sirt") == ["anna", "bert"] and np.isfinite(volume(folder)).all()
    assert record(folder)["process_peak_memory_mb"] is None
    main(sirt("predict", tmp_path, f"--data.xrays={measured}"))
    assert when == {file: file.stat().st_mtime_ns for file in when}
    main(["page", str(tmp_path)])


def test_files_and_folders_appear_whole_or_not_at_all(on_windows, tmp_path):
    folder = tmp_path / "out"
    with files.alone_in(folder, "out"):
        for word in ("first", "second"):
            with files.atomic_directory(folder / "case") as part:
                (part / "text.txt").write_text(word)
            with files.atomic_write(folder / "text.txt") as part:
                part.write_text(word)
        with pytest.raises(KeyError), files.atomic_directory(folder / "case") as part:
            raise KeyError
    assert (folder / "case" / "text.txt").read_text() == (folder / "text.txt").read_text() == "second"
    assert sorted(os.listdir(folder)) == [".lock", "case", "text.txt"]
    files.remove_leftovers(folder)


def test_memory_that_is_not_told_refuses_nothing(on_windows):
    assert free_memory() is None and math.isnan(profiling.peak_memory(profiling.CPU))
    check_memory(2**60, "this", "give less", now=True)


def test_a_dropped_ctrl_c_comes_again_and_waits_while_workers_start(on_windows):
    with preparation._without_ctrl_c():
        pass
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        console._send_to_main_thread(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [signal.SIGINT]
