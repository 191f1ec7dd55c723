"""What becomes of input as strangers and attackers may give it: scripted tries, then fuzzers.

    python tests/benchmark/robustness.py tries [words in their names]
    python tests/benchmark/robustness.py fuzz <minutes> <hypothesis or atheris> [readers of tests/fuzzing.py, all if none]

Each try runs in this process through a main function or the Python API, in a folder of its own, for at most 10
seconds of computing (a minute on the clock).
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
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from phydict.evaluation import read_csv, write_csv

sys.path.insert(0, str(Path(__file__).parents[1]))

OUT = Path(__file__).with_suffix(".csv")
SECONDS, GIGABYTES = 10, 2
RAW = re.compile(r"'NoneType'|has no attribute|object is not|invalid literal for|to unpack|list index|Error\(|"
                 r"unhashable|not supported between|unsupported operand|expected str,|an integer is required|"
                 r"^error: '?\[?(Errno|\w+)'?$|embedded null|object cannot|does not match format|positional_argument")
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
    """Raises Hang in the block after so many seconds of computing, or six times as many on the clock."""
    before = {number: signal.signal(number, _ring) for number in (signal.SIGALRM, signal.SIGPROF)}
    signal.alarm(6 * seconds)
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
    seconds = 30 * SECONDS if several else SECONDS
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


def run_tries(words: str = "") -> Counter:
    """(group, kind of fault or "fine") -> how often; prints what is wrong."""
    from tries import Place, tries

    counts, log = Counter(), []
    with tempfile.TemporaryDirectory(prefix="tries") as root:
        for n, one in enumerate(tries()):
            if words not in f"{one.group}: {one.name}":
                continue
            place = Place(Path(root) / f"{n:03d}")
            began = time.monotonic()
            wrong = judge(one, place)
            log.append(f"{n} {one.group}: {one.name} [{time.monotonic() - began:.1f} s]\n{place.said}\n")
            counts[one.group, wrong.partition(":")[0] or "fine"] += 1
            if wrong:
                print(f"{n} {one.group}: {one.name}\n    {wrong}", flush=True)
    if file := os.environ.get("ROBUSTNESS_LOG"):
        Path(file).write_text("\n".join(log), errors="backslashreplace")
    return counts


def count(rows: list[dict]) -> None:
    """Puts rows in the table of counts, in place of those of the same name."""
    commit = subprocess.run(["git", "-C", str(OUT.parent), "rev-parse", "--short", "HEAD"], capture_output=True, text=True,
                            check=True).stdout.strip()
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
    counts = run_tries(given[0] if given else "")
    rows = [{"what": f"tries: {group}", "inputs": sum(n for (other, _), n in counts.items() if other == group),
             "faults": sum(n for (other, kind), n in counts.items() if other == group and kind != "fine")}
            for group in dict.fromkeys(group for group, _ in counts)]
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    if not given:
        count(rows)


if __name__ == "__main__":
    main()
