"""What every long command tells: on a terminal, in a log file, to machines, to nobody, and when it is stopped."""

from __future__ import annotations

import ctypes
import fcntl
import json
import locale
import os
import re
import runpy
import signal
import struct
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import yaml
from command_lines import arguments
from ct_files import save_ct, thorax_hu
from inference.runs import phantoms, sirt, xrays
from processes import INFER, Python

from phydict.cli.infer import main as infer
from phydict.cli.train import main as train
from phydict.runtime.console import cli_errors, ended_by_sigterm
from phydict.runtime.progress import CaseProgress
from phydict.runtime.reading import read_ids
from phydict.training import PriorTraining

prepare_cts = runpy.run_path(str(Path(__file__).parents[1] / "data" / "prepare_cts.py"))["main"]


@pytest.fixture(scope="module")
def made(tmp_path_factory, trained) -> Path:
    """What the commands read: two folders of X-rays, two CTs, a comparison, a checkpoint."""
    folder = tmp_path_factory.mktemp("made")
    for name in "ab":
        xrays(folder / "xrays" / name)
        save_ct(folder / "cts" / f"{name}.nii.gz", thorax_hu())
    (folder / "comparison.yaml").write_text(yaml.safe_dump({
        "phantoms": 2, "base": {"voxels": 16, "detector": 24, "views": 3},
        "axes": {"method": ["sirt"], "method.iterations": [3]}}))
    (folder / "trained").symlink_to(trained)
    return folder


COMMANDS = {
    "predict": (infer, lambda made, cache, out: sirt("predict", out, f"--data.xrays={made / 'xrays'}")),
    "test": (infer, lambda made, cache, out: phantoms(out, 2)),
    "ablate": (infer, lambda made, cache, out: ["ablate", "-c", str(made / "comparison.yaml"), "--out", str(out)]),
    "fit": (train, lambda made, cache, out: arguments(
        out, cache, "--trainer.max_epochs=2", "--progress.interval=0", "--trainer.limit_val_batches=0")),
    "validate": (train, lambda made, cache, out: ["validate", *arguments(
        out, cache, f"--ckpt_path={made / 'trained' / 'last.ckpt'}")[1:]]),
    "export": (train, lambda made, cache, out: ["export", "--out", f"{out}.safetensors", "--checkpoint",
                                                str(made / "trained" / "last.ckpt")]),
    "prepare": (prepare_cts, lambda made, cache, out: [str(made / "cts"), str(out), "--voxels=32"]),
}
RESUMED = ("predict", "test", "ablate", "fit", "prepare")


@pytest.fixture
def run(made, cache, tmp_path, capfd) -> Callable[..., str]:
    """Runs a command into <tmp_path>/out with more options and returns what it wrote to standard error."""
    def told(command: str, *more: str, out: str = "out") -> str:
        main, arguments_of = COMMANDS[command]
        capfd.readouterr()
        main([*arguments_of(made, cache, tmp_path / out), *more])
        return capfd.readouterr().err
    return told


@contextmanager
def terminal() -> Iterator[list[bytes]]:
    """Standard error is a terminal of 80 columns inside; what was written to it is whole afterwards."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    written: list[bytes] = []

    def read() -> None:
        with suppress(OSError):  # the other end is closed
            while some := os.read(ours, 4096):
                written.append(some)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    with pytest.MonkeyPatch.context() as patch, open(theirs, "w") as stream:
        patch.setenv("TERM", "xterm")
        patch.setenv("COLUMNS", "80")
        patch.setattr(sys, "stderr", stream)
        yield written
    reader.join(10)
    os.close(ours)


def shown_in(page: Path) -> set[str]:
    """The ids of the cases on a page."""
    content = re.search(r'id="content">(.*)</script>\n<script>', page.read_text()).group(1)
    return {case["record"]["case"] for case in json.loads(content)["cases"]}


def stop_once(monkeypatch) -> None:
    """Presses Ctrl-C after the first case and, in training, in the second epoch."""
    finished, step = CaseProgress.finished, PriorTraining.training_step
    pressed = []

    def stopping(progress: CaseProgress, summary: str) -> None:
        finished(progress, summary)
        if "loss" not in summary and not pressed:
            pressed.append(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    def stopping_step(task: PriorTraining, batch: dict, index: int) -> object:
        if task.global_step == 5 and not pressed:
            pressed.append(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return step(task, batch, index)

    monkeypatch.setattr(CaseProgress, "finished", stopping)
    monkeypatch.setattr(PriorTraining, "training_step", stopping_step)


@pytest.fixture
def handlers() -> Iterator[None]:
    """Lightning ignores SIGINT once it was stopped by it, and so does Python where it was started in the background."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("command", RESUMED)
def test_ctrl_c_on_a_terminal_says_how_to_resume_and_a_log_file_tells_the_rest(command, run, handlers, tmp_path,
                                                                               monkeypatch):
    stop_once(monkeypatch)
    with terminal() as written, pytest.raises(SystemExit) as stopped:
        run(command)
    assert stopped.value.code == 130
    screen = b"".join(written).decode()
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in re.split(r"[\r\n]+", screen)]
    bars = [line for line in lines if "━" in line]
    assert bars and max(map(len, bars)) <= 80, bars
    assert any(re.search(r"\d/\d+ \d:\d\d:\d\d so far, [-\d]:[-\d]{2}:[-\d]{2} to go", bar) for bar in bars)
    assert screen.rindex("\x1b[?25h") > screen.rindex("\x1b[?25l"), "the cursor is not given back"
    assert any(f"results in {tmp_path / 'out'}" in line for line in lines)
    advice = next(line for line in lines if line.startswith("stopped by a signal; to resume, "))
    if command == "fit":
        assert advice.endswith(f"add --ckpt_path {tmp_path / 'out' / 'last.ckpt'}")
        more = [f"--ckpt_path={tmp_path / 'out' / 'last.ckpt'}"]
    else:
        assert advice.endswith("run the same command again")
        more = []
    if command in ("predict", "test", "ablate"):
        assert len(shown_in(tmp_path / "out" / "index.html")) == 1
    log = run(command, *more)
    assert f"results in {tmp_path / 'out'}" in log and "\x1b" not in log
    wanted = r"step 7 of 8, about \d+ s to go: loss" if command == "fit" else r"\(1 of 1\)$"
    assert re.search(wanted, log, flags=re.MULTILINE), log


@pytest.mark.parametrize("command", ["predict", "test", "ablate"])
def test_a_scheduler_ends_a_command_as_ctrl_c_does(command, run, handlers, tmp_path, monkeypatch):
    before, finished = signal.getsignal(signal.SIGTERM), CaseProgress.finished

    def ending(progress: CaseProgress, summary: str) -> None:
        finished(progress, summary)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(CaseProgress, "finished", ending)
    with pytest.raises(SystemExit) as stopped:
        run(command)
    assert stopped.value.code == 143
    assert len(shown_in(tmp_path / "out" / "index.html")) == 1
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("command", ["predict", "test", "ablate"])
def test_a_run_that_is_stopped_before_a_case_is_finished_writes_no_page(command, run, handlers, tmp_path, monkeypatch):
    monkeypatch.setattr(CaseProgress, "case", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit) as stopped:
        run(command)
    assert stopped.value.code == 130 and not (tmp_path / "out" / "index.html").exists()


@pytest.mark.parametrize("command", sorted({*COMMANDS} - {"test"}))  # which is as predict
def test_machines_read_a_json_object_on_each_line_and_quiet_tells_nothing(command, run, tmp_path):
    events = [json.loads(line) for line in run(command, "--json_lines").splitlines()]
    begins = [event for event in events if event["event"] == "begin"]
    assert command == "validate" or any(str(tmp_path / "out") in str(event.get("out")) for event in begins)
    assert command == "export" or events[-1]["seconds_to_go"] == 0
    assert run(command, "--quiet", out="silent") == ""


@pytest.mark.parametrize("command, args", [
    (infer, ["predict", "--data.xrays=absent"]), (infer, ["predict", "--no_such_option=1"]),
    (infer, ["ablate", "-c", "absent.yaml"]), (infer, ["page", "absent"]), (train, ["export", "--checkpoint=absent"])])
def test_machines_read_what_was_wrong_as_json_too(command, args, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for option in ("--json_lines", "--quiet"):
        with pytest.raises(SystemExit, match="2"):
            command([*args, option])
        said = capsys.readouterr().err.splitlines()
        if option == "--json_lines":
            last = json.loads(said[-1])
            assert last["event"] == "error" and all(json.loads(line) for line in said)
        else:
            assert said[-1] == f"error: {last['text']}"


def test_a_run_that_overwrites_says_that_it_begins_anew(run, handlers, monkeypatch, capfd):
    run("predict")
    stop_once(monkeypatch)
    with pytest.raises(SystemExit):
        run("predict", "--model.overwrite=true")
    assert "with --model.overwrite true does the finished cases again" in capfd.readouterr().err


def test_a_second_ctrl_c_stops_a_training_at_once_and_it_says_that_nothing_is_kept(run, handlers, monkeypatch, capfd):
    def pressed_twice(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the step went on")

    monkeypatch.setattr(PriorTraining, "training_step", pressed_twice)
    with pytest.raises(SystemExit) as stopped:
        run("fit")
    assert stopped.value.code == 130
    assert "run the same command again: no checkpoint was written" in capfd.readouterr().err


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_strikes_in_a_callback_of_compiled_code_which_drops_it_ends_the_run_too(number, code, handlers):
    strike = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))
    with pytest.raises(SystemExit) as stopped, cli_errors(), ended_by_sigterm():
        strike()
        time.sleep(20)
        pytest.fail("the run went on")
    assert stopped.value.code == code


def test_a_training_that_is_stopped_while_it_learns_reports_says_that_nothing_is_kept(run, handlers, monkeypatch,
                                                                                      capfd):
    monkeypatch.setattr(PriorTraining, "learn_reports", lambda _: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit) as stopped:
        run("fit")
    assert stopped.value.code == 130
    assert "to resume, run the same command again: no checkpoint was written" in capfd.readouterr().err


def test_a_training_that_is_stopped_before_it_begins_names_no_checkpoint(run, handlers, monkeypatch, capfd):
    monkeypatch.setattr("phydict.cli.train.check_writable", lambda *_: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit):
        run("fit")
    assert "to resume, run the same command again\n" in capfd.readouterr().err


def test_a_training_that_goes_back_and_is_stopped_at_once_names_no_later_checkpoint(run, handlers, made, tmp_path,
                                                                                   monkeypatch, capfd):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("last.ckpt", "best.ckpt"):
        (out / name).write_bytes((made / "trained" / "last.ckpt").read_bytes())
    monkeypatch.setattr(PriorTraining, "on_fit_start", lambda _: signal.raise_signal(signal.SIGINT))
    with pytest.raises(SystemExit):
        run("fit", "--trainer.max_epochs=3", f"--ckpt_path={out / 'best.ckpt'}")
    assert "to resume, run the same command again: no checkpoint was written" in capfd.readouterr().err


@pytest.fixture
def ascii_locale() -> Iterator[None]:
    """Text files are ASCII unless it is said otherwise, as in a locale that is not UTF-8."""
    before = locale.setlocale(locale.LC_CTYPE)
    locale.setlocale(locale.LC_CTYPE, "C")
    yield
    locale.setlocale(locale.LC_CTYPE, before)


@pytest.mark.parametrize("command, table", [("test", "sirt/results.md"), ("ablate", "tables.md")])
def test_all_is_written_where_nobody_reads_what_is_printed_and_no_more_is_said(command, table, made, cache, tmp_path):
    unread = "import os, sys\nread, write = os.pipe()\nos.close(read)\nsys.stdout = open(write, 'w')\n"
    run = Python(unread + INFER, *COMMANDS[command][1](made, cache, tmp_path / "out"))
    assert run.wait() == 1 and "Broken pipe" not in run.err and "error" not in run.err, run.err
    assert (tmp_path / "out" / table).is_file() and len(shown_in(tmp_path / "out" / "index.html")) == 2


@pytest.mark.skipif(sys.flags.utf8_mode, reason="Python writes UTF-8 in every locale")
@pytest.mark.parametrize("command, tables", [("test", "sirt/results.md"), ("ablate", "tables.md")])
def test_tables_are_utf_8_in_every_locale(command, tables, run, ascii_locale, tmp_path):
    run(command)
    assert "PSNR (dB) ↑" in (tmp_path / "out" / tables).read_text(encoding="utf-8")


@pytest.mark.skipif(sys.flags.utf8_mode, reason="Python writes UTF-8 in every locale")
def test_the_list_of_held_out_cts_is_utf_8_in_every_locale(made, cache, tmp_path, ascii_locale):
    cts = tmp_path / "cts"
    cts.mkdir()
    for name, of in (("Müller", "a"), ("b", "b")):
        (cts / f"{name}.nii.gz").symlink_to(made / "cts" / f"{of}.nii.gz")
    train(arguments(tmp_path / "out", cache, f"--data.cts={cts}", "--data.holdout.ids=[ller]",
                    "--trainer.max_epochs=1", "--trainer.limit_val_batches=0"))
    assert read_ids(tmp_path / "out" / "held_out.txt", "data.only") == ["Müller"]
