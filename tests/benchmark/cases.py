"""Seconds and peak memory of `infer.py predict` against the number of cases.

    python tests/benchmark/cases.py [<number of cases> ...]

Copies of the shipped example, 128^3 voxels of each from eight views by the default method, in one process for every
number of cases (1, 2, 4 and 8). seconds is of the whole command, start included; peak_mib of its process. Prints the
seconds of a start and of a case, fitted in a line, and writes cases.csv beside this file; rows of machines with other
instructions stay.
"""

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from phydict.evaluation import read_csv, write_csv
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import CPU

FILE = Path(__file__).with_suffix(".csv")
EXAMPLE = Path("data/example/xrays")


def measured(cases: int) -> dict:
    """The figures of one run of predict."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for n in range(cases):
            shutil.copytree(EXAMPLE, folder / "cases" / f"case_{n}")
        start = time.perf_counter()
        subprocess.run([sys.executable, "infer.py", "predict", "--quiet", "--data.xrays", str(folder / "cases"),
                        "--model.out", str(folder / "out")], check=True)
        seconds = time.perf_counter() - start
    # Of all children so far the greatest: runs go from few cases to many.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return {"cases": cases, "seconds": round(seconds, 1), "peak_mib": round(peak), "threads": torch.get_num_threads(),
            "instruction_set": instruction_set(CPU)}


if __name__ == "__main__":
    own = [measured(cases) for cases in sorted(map(int, sys.argv[1:] or ["1", "2", "4", "8"]))]
    kept = [row for row in read_csv(FILE) if row["instruction_set"] != instruction_set(CPU)]
    write_csv(FILE, [*kept, *own])
    each, start = np.polyfit([row["cases"] for row in own], [row["seconds"] for row in own], 1)
    print(f"start {start:.1f} s, each case {each:.1f} s")
    for row in own:
        print(row)
