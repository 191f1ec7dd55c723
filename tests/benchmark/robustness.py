"""What becomes of input as strangers and attackers may give it: scripted tries, then fuzzers.

    python tests/benchmark/robustness.py tries [groups, or words in the names of tries]
    python tests/benchmark/robustness.py fuzz <minutes> <hypothesis or atheris> [readers of tests/fuzzing.py, else all]

Each try runs in this process through a main function or the Python API, in a folder of its own, for at most 10
seconds of computing (five minutes on the clock).
It is a fault where an exception other than a refusal comes out, where a refusal is not one sentence that names what is
wrong (the try says which words), where the exit code is wrong, where an input changed, and where something half-written
is left. Tries that are fine print nothing. The fuzzers are those of tests/fuzzing.py, with equal shares of the time.
The counts replace the rows of the same name in robustness.csv beside this file; tries picked by words are not counted.
ROBUSTNESS_LOG names a file for what every try printed, FUZZ_FINDINGS a folder for the inputs of the fuzzers' faults.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from phydict.evaluation import read_csv, write_csv

sys.path.insert(0, str(Path(__file__).parents[1]))

OUT = Path(__file__).with_suffix(".csv")
SECONDS, GIGABYTES = 10, 2
RAW = re.compile(r"'NoneType'|has no attribute|object is not|invalid literal for|to unpack|list index|Error\(|"
                 r"unhashable|not supported between|unsupported operand|expected str,|an integer is required|"
                 r"^error: '?\[?(Errno|\w+)'?$|embedded null|object cannot|does not match format|positional_argument|"
                 r"Parser key|<class '|unrecognized arguments|Expected an? ")
"""Words of Python's own that tell a user nothing."""


@dataclass(frozen=True)
class Try:
    """One input. good: whether it must work (True), be refused (False) or either (None); words: of a refusal."""

    group: str
    name: str
    good: bool | None
    words: tuple[str, ...]
    work: Callable


class Hang(BaseException):
    """A try took too long."""


def _ring(*_):
    raise Hang


@contextlib.contextmanager
def limited(seconds: int = SECONDS):
    """Raises Hang in the block after so many seconds of computing, or 30 times as many on the clock."""
    before = {number: signal.signal(number, _ring) for number in (signal.SIGALRM, signal.SIGPROF)}
    signal.alarm(30 * seconds)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def state(folder: Path) -> dict[str, str]:
    """What is in a folder: names and checksums."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        found[name] = (f"link to {os.readlink(path)}" if path.is_symlink() else
                       hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder")
    return found


def judge(one: Try, place) -> str:
    """What is wrong with what becomes of a try; empty where nothing is."""
    out, err, code, broken = io.StringIO(), io.StringIO(), 0, ""
    place.begin()
    several = one.group in ("interruptions", "surroundings")  # processes, which must first start
    seconds = 6 * SECONDS if several else SECONDS
    began, peak = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    here = os.getcwd()
    try:
        with limited(seconds), contextlib.redirect_stdout(out), contextlib.redirect_stderr(
            err), warnings.catch_warnings():
            one.work(place)
    except Hang:
        broken = f"hang: more than {seconds} s"
    except SystemExit as stop:
        code = stop.code or 0
    except (TypeError, AttributeError, IndexError):
        if not place.api or "TypeError" not in one.words:  # a call with a wrong type may end as Python does it
            broken = f"trace: {traceback.format_exc()}"
    except (ValueError, OSError, FloatingPointError) as error:
        code = 2
        print(f"error: {error}", file=err)
        if not place.api or "\n" in str(error).strip():
            broken = f"trace: {traceback.format_exc()}"
    except BaseException:
        broken = f"trace: {traceback.format_exc()}"
    finally:
        os.chdir(here)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    took, grown = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    said = err.getvalue()
    place.said = out.getvalue() + said
    last = said.strip().splitlines()[-1] if said.strip() else ""
    if broken:
        return broken
    if "Traceback" in said:
        return f"trace: {said}"
    if took > seconds:
        return f"hang: {took:.0f} s"
    if grown > GIGABYTES * 2**20:
        return f"memory: {grown / 2**20:.1f} GiB"
    if code not in (0, 2) or (one.good is True and code) or (one.good is False and not code):
        return f"code: {code}; {last}"
    if code == 2 and (not last.startswith("error: ") or RAW.search(last) or len(last) > 900):
        return f"sentence: {last}"
    if code == 2 and (lacking := [word for word in one.words if word.lower() not in said.lower(
        ) and word != "TypeError"]):
        return f"sentence: does not name {lacking}: {last}"
    return place.harm()


def run_tries(words: Sequence[str]) -> None:
    """Runs groups and counts them, or tries with one of these words in their names; prints what is wrong."""
    from tries import Place, tries

    chosen = list(enumerate(tries()))
    known = {one.group for _, one in chosen}
    whole = known.issuperset(words)
    chosen = [(n, one) for n, one in chosen if not words or (
        one.group in words if whole else any(word in f"{one.group}: {one.name}" for word in words))]
    if words and whole:
        chosen.sort(key=lambda each: words.index(each[1].group))
    with tempfile.TemporaryDirectory(prefix="tries") as root:
        for group, members in itertools.groupby(chosen, lambda each: each[1].group):
            verdicts = [_run(one, Place(Path(root) / f"{n:04d}"), n) for n, one in members]
            row = {"what": f"tries: {group}", "inputs": len(verdicts), "faults": sum(map(bool, verdicts))}
            print(*row.values(), flush=True)
            if whole:
                count([row])


def _run(one: Try, place, number: int) -> str:
    began = time.monotonic()
    wrong = judge(one, place)
    if wrong:
        print(f"{number} {one.group}: {one.name}\n    {wrong}", flush=True)
    if file := os.environ.get("ROBUSTNESS_LOG"):
        with open(file, "a", errors="backslashreplace") as log:
            log.write(f"{number} {one.group}: {one.name} [{time.monotonic() - began:.1f} s]\n{place.said}\n\n")
    shutil.rmtree(place.root, ignore_errors=True)
    return wrong


def count(rows: list[dict]) -> None:
    """Puts rows in the table of counts, in place of those of the same name."""
    commit = subprocess.run(["git", "-C", str(OUT.parent), "rev-parse", "--short", "HEAD"], capture_output=True,
                            text=True, check=True).stdout.strip()
    names = {row["what"] for row in rows}
    kept = [row for row in read_csv(OUT) if row["what"] not in names] if OUT.exists() else []
    write_csv(OUT, [*kept, *(row | {"commit": commit} for row in rows)])


def main() -> None:
    kind, *given = sys.argv[1:]
    if kind == "fuzz":
        from fuzz import fuzz
        from fuzzing import TARGETS

        minutes, engine, *names = given
        for found in fuzz(60 * float(minutes), engine, names or list(TARGETS)):
            count([{"what": f"{engine}: {found['target']}", "minutes": round(found["seconds"] / 60, 2),
                    "inputs": found["runs"], "read": found["read"], "faults": len(found["faults"])}])
        return
    run_tries(given)


if __name__ == "__main__":
    main()
