"""Tries of robustness.py that stop runs, share their folder or leave them no room."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time

from tries import ROOT, SIRT

from phydict.datasets import load_ct
from phydict.page import CASE_FILES


def interruptions():
    """Runs that are stopped, share a folder or lack room: nothing finished is lost, and the next run continues."""
    code = "import sys; from phydict.cli.infer import main; main(sys.argv[1:])"

    def command(p, *more, cases=3) -> list[str]:
        for k in range(cases):
            p.case(f"case{k}")
        p.started()
        return [sys.executable, "-c", code, "predict", *SIRT[:2], "--model.method.init_args.iterations=400",
                "--model.grid.voxels=32", "--trainer.accelerator=cpu", f"--data.xrays={p.given}",
                f"--model.out={p.out}", *more]

    def start(args, **settings) -> subprocess.Popen:
        return subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                                env=os.environ | {
                                "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}, **settings)

    def finished(p) -> dict[str, bytes]:
        return {str(f): f.read_bytes() for f in (p.out / "sirt").glob("case*/*")}

    def whole(p, cases=3) -> None:
        for k in range(cases):
            names = {f.name for f in (p.out / "sirt" / f"case{k}").iterdir()}
            assert names == {"volume.nii.gz", "panel.png", "reconstruction.json", *CASE_FILES}, names
            load_ct(p.out / "sirt" / f"case{k}" / "volume.nii.gz")

    def goes_on(p, args, before) -> None:
        """The same command again ends well, keeps what was finished, and leaves nothing behind."""
        done = start(args)
        _out, err = done.communicate(timeout=1000)
        assert done.returncode == 0, err
        after = finished(p)
        assert all(after[name] == content for name, content in before.items()), "a finished case was changed"
        whole(p)

    def stopped(number, delay):
        def work(p):
            args = command(p)
            run = start(args)
            place = p.out / "sirt"
            while run.poll() is None and not (place.is_dir() and any(place.iterdir())):
                time.sleep(0.01)
            time.sleep(delay)
            run.send_signal(number)
            _out, err = run.communicate(timeout=1000)
            assert "Traceback" not in err, err
            assert run.returncode in (0, -number, 130, 143), (run.returncode, err)
            goes_on(p, args, {k: v for k, v in finished(p).items()})
        return work

    for number, name in ((signal.SIGKILL, "kill -9"), (signal.SIGINT, "SIGINT"), (signal.SIGTERM, "SIGTERM")):
        for delay in (0.0, 0.15, 0.6):
            yield f"{name} {delay} s after the first file", True, "", stopped(number, delay)

    def overwriting(p):
        args = command(p)
        goes_on(p, args, {})
        before = finished(p)
        run = start([*args, "--model.overwrite=true"])
        while run.poll() is None and not list((p.out / "sirt").glob(".case*")):
            time.sleep(0.01)
        run.kill()
        run.communicate()
        goes_on(p, args, {})
        assert finished(p).keys() == before.keys()

    yield "kill -9 while a case is overwritten", True, "", overwriting

    def small(p):
        args = command(p)
        run = start(args, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)))
        _out, err = run.communicate(timeout=1000)
        assert run.returncode == 2 and "Traceback" not in err and "could not be written" in err, (run.returncode, err)
        assert not [f for f in (p.out / "sirt").iterdir() if f.name != ".lock"], "something half-written is left"
        goes_on(p, args, {})

    yield "files of 20 kB at most", True, "", small

    def full(p):
        p.out.mkdir()
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(p.out)],
            capture_output=True).returncode:
            return
        try:
            run = start(command(p))
            _out, err = run.communicate(timeout=1000)
            assert run.returncode == 2 and "Traceback" not in err and "free some space" in err, (run.returncode, err)
            left = [f.name for f in (p.out / "sirt").iterdir()]
            assert not [name for name in left if name.startswith(".")], left
        finally:
            subprocess.run(["umount", str(p.out)])

    yield "a full disk", True, "", full

    def together(*more):
        def work(p):
            args = command(p)
            runs = [start([*args, *(extra for extra in (more if k else ()))]) for k in range(2)]
            told = [(run.communicate(timeout=1000)[1], run.returncode) for run in runs]
            assert all("Traceback" not in err for err, _ in told), told
            whole(p)
            if not more:
                assert [code for _, code in told] == [0, 0], told
            else:
                seeds = {json.loads((p.out / "sirt" / f"case{k}" / "reconstruction.json").read_text())[
                "seed"] for k in range(3)}
                assert [code for _, code in told] != [0, 0] or len(seeds) == 1, (told, seeds)
        return work

    yield "two runs into one folder", True, "", together()
    yield "two runs of other seeds into one folder", True, "", together("--model.seed=1")

    def nobody(p):
        args = command(p)
        for folder in (p.given, *p.given.rglob("*")):
            os.chmod(folder, 0o755 if folder.is_dir() else 0o644)
        os.chmod(p.root, 0o755), os.chmod(p.root.parent, 0o755)
        p.out.mkdir()
        try:
            run = start(args, user=65534, group=65534, extra_groups=[])
        except PermissionError:  # where that user may not run Python either, or nobody else can be run as
            return
        _out, err = run.communicate(timeout=1000)
        assert "Traceback" not in err and run.returncode == 2, (run.returncode, err)

    yield "as a user who may not write there", True, "", nobody
    yield "output closed", True, "", lambda p: (run := start([
        "sh", "-c", 'exec "$0" "$@" >&-', *command(p)]), told := run.communicate(timeout=1000), _must(
            run.returncode == 0 and "Traceback" not in told[1], told))
    yield "no UTF-8 console", True, "", lambda p: (p.case("käse"), run := subprocess.Popen(
        command(p), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {
            "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"}), told := run.communicate(timeout=1000), _must(
                run.returncode == 0 and "Traceback" not in told[1], told))
    yield "a folder that is gone", False, "", lambda p: (args := command(p), gone := p.root / "gone", gone.mkdir(),
        run := start(
        ["sh", "-c", 'cd "$0" && rmdir "$0" && exec "$@"', str(gone), *args]), told := run.communicate(timeout=1000),
        _must(
            "Traceback" not in told[1] and run.returncode in (0, 2), (run.returncode, told)), sys.stderr.write(
                "error: as it should be"), sys.exit(2))


def _must(holds: bool, told: object) -> None:
    if not holds:
        raise AssertionError(told)
