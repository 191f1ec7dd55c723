"""The fuzzers of tests/fuzzing.py for as long as there is time: by Hypothesis, and by atheris where it is installed.

    python tests/benchmark/fuzz.py <hypothesis or atheris> <target> <seconds>

runs one of them on one target and prints what it found; robustness.py runs all of them.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS))
MOST_KB, MOST_SECONDS = 3 * 2**20, 15
FINDINGS = Path(os.environ.get("FUZZ_FINDINGS", tempfile.gettempdir())) / "fuzz_findings"


class Found:
    """What a fuzzer found, each fault once, by its kind and place."""

    def __init__(self, name: str):
        self.name, self.runs, self.read, self.faults = name, 0, 0, {}

    def run(self, target, content: bytes, folder: Path) -> None:
        from fuzzing import check

        self.runs += 1
        signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
        try:
            self.read += check(target, content, folder)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | SystemExit) and not isinstance(error, TimeoutError):
                raise
            place = [f for f in traceback.extract_tb((
            error.__cause__ or error).__traceback__) if "phydict" in f.filename]
            key = type(error).__name__
            if place:
                key += f" {place[-1].filename.rpartition('phydict/')[2]}:{place[-1].lineno}"
            key += " " + re.sub(r"[0-9]+", "#", str(error).rpartition("/")[2])[:60]
            if key not in self.faults:
                self.faults[key] = repr(error)[:500]
                FINDINGS.mkdir(parents=True, exist_ok=True)
                number = len(list(FINDINGS.iterdir()))
                (FINDINGS / f"{number:03d}-{self.name.replace(' ', '_')}-{target.name}").write_bytes(content)
                print(f"{self.name}: {key}\n    {self.faults[key]}", flush=True)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if peak > MOST_KB and "memory" not in self.faults:
            self.faults["memory"] = f"{peak / 2**20:.1f} GiB"
            FINDINGS.mkdir(parents=True, exist_ok=True)
            (FINDINGS / f"memory-{self.name}-{target.name}").write_bytes(content)
            print(f"{self.name}: memory {peak / 2**20:.1f} GiB", flush=True)

    def tell(self) -> None:
        print("RESULT " + json.dumps({"target": self.name, "runs": self.runs, "read": self.read,
                                      "faults": list(self.faults)}), flush=True)


def _late(*_):
    raise TimeoutError(f"more than {MOST_SECONDS} s of computing")


def by_hypothesis(name: str, seconds: float) -> None:
    from fuzzing import TARGETS, contents
    from hypothesis import HealthCheck, Phase, given, seed, settings

    signal.signal(signal.SIGPROF, _late)
    found, end, turn = Found(name), time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < end:
            @seed(turn)
            @settings(max_examples=200, deadline=None, database=None, phases=[Phase.generate],
                      suppress_health_check=list(HealthCheck))
            @given(contents(name))
            def once(content):
                if time.monotonic() < end:
                    found.run(TARGETS[name], content, Path(folder))

            once()
            turn += 1
    found.tell()


def by_atheris(name: str, seconds: float) -> None:
    import atheris

    with atheris.instrument_imports(include=["phydict", "yaml", "pydicom", "nibabel"]):
        from fuzzing import TARGETS

    target, found, end = TARGETS[name], Found(name), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        corpus, work = Path(folder) / "corpus", Path(folder) / "work"
        corpus.mkdir(), work.mkdir()
        for n, sample in enumerate(target.samples()):
            (corpus / f"{n}").write_bytes(sample)
        words = Path(folder) / "words"
        words.write_text("".join('"' + "".join(f"\\x{byte:02x}" for byte in piece) + '"\n' for piece in target.pieces
                                 if len(piece) < 60))

        def once(content: bytes) -> None:
            signal.signal(signal.SIGPROF, _late)
            if time.monotonic() > end:
                found.tell()
                os._exit(0)
            found.run(target, content, work)

        longest = max(200_000, 2 * max(map(len, target.samples())))
        atheris.Setup([sys.argv[0], str(corpus), f"-dict={words}", f"-max_len={longest}", "-rss_limit_mb=6000",
                       "-timeout=600", "-verbosity=0", f"-artifact_prefix={folder}/"], once,
                      enable_python_coverage=True)
        atheris.Fuzz()


def fuzz(seconds: float, engine: str, names: list[str]) -> Iterator[dict]:
    """Runs an engine ("hypothesis" or "atheris") on targets in processes of their own, with equal shares of the time.

    Yields {"target", "seconds", "runs", "read", "faults"} after each; a process that ended by itself is a fault.
    """
    for name in names:
        share = seconds / len(names)
        said = (_forked if engine == "hypothesis" else _started)(name, share)  # atheris must see what is imported
        told = [json.loads(line[7:]) for line in said.splitlines() if line.startswith("RESULT ")]
        if not told:
            told = [{"target": name, "runs": 0, "read": 0, "faults": ["ended by itself"]}]
        print("\n".join(line for line in said.splitlines() if not line.startswith("RESULT ")), flush=True)
        yield {"seconds": share} | told[-1]


def _started(name: str, share: float) -> str:
    done = subprocess.run([sys.executable, __file__, "atheris", name, str(share)], capture_output=True, text=True,
                          timeout=10 * share + 300)
    return done.stdout + done.stderr[-1500:] * ("RESULT " not in done.stdout)


def _forked(name: str, share: float) -> str:
    with tempfile.NamedTemporaryFile("r") as told:
        child = multiprocessing.get_context("fork").Process(target=_told_in, args=(told.name, name, share))
        child.start()
        child.join()
        return told.read()


def _told_in(file: str, name: str, share: float) -> None:
    with open(file, "w") as out, contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        by_hypothesis(name, share)


if __name__ == "__main__":
    {"hypothesis": by_hypothesis, "atheris": by_atheris}[sys.argv[1]](sys.argv[2], float(sys.argv[3]))
