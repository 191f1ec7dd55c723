"""What another program on the same cores costs a reconstruction, by how long torch's threads spin for each other.

    python tests/benchmark/beside.py

The embedded example on as many threads as there are cores, alone and beside a program that keeps the last core busy;
GOMP_SPINCOUNT as importing phydict before torch sets it, and as libgomp has it by itself. Writes beside.csv beside this
file: seconds, the median of three after a first one that is not counted, their ratio to those alone as phydict sets it,
and PSNR.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import nibabel
import torch

import phydict
from phydict.evaluation import volume_metrics, write_csv
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import CPU

EXAMPLE = Path(__file__).parents[2] / "data" / "example"
METHODS = ("phydict_learned", "sirt")
SPINS = {"phydict's": "3000", "libgomp's": "300000"}
BUSY = [sys.executable, "-c", "import os; os.sched_setaffinity(0, {os.cpu_count() - 1})\nwhile True: pass"]


def measured(method: str) -> tuple[float, float]:
    """Seconds and PSNR in this process."""
    case, seconds = phydict.load_xrays(EXAMPLE / "xrays"), []
    for _ in range(4):
        start = time.perf_counter()
        found = phydict.reconstruct(case["xrays"], case["beam"], method=method)
        seconds.append(time.perf_counter() - start)
    truth = torch.from_numpy(nibabel.load(EXAMPLE / "truth.nii.gz").get_fdata(dtype="float32"))
    return median(seconds[1:]), volume_metrics(found.volume[None, None], truth[None, None])["psnr"]


def row(method: str, spins: str, busy: int) -> dict:
    """One line of the table but for the ratio, measured in a process of its own."""
    others = [subprocess.Popen(BUSY) for _ in range(busy)]
    try:
        done = subprocess.run([sys.executable, "-W", "ignore", __file__, method], check=True, text=True,
                              stdout=subprocess.PIPE, env=os.environ | {"GOMP_SPINCOUNT": SPINS[spins]})
    finally:
        for other in others:
            other.kill()
    seconds, psnr = json.loads(done.stdout)
    return {"method": method, "spins": spins, "busy_programs": busy, "seconds": seconds, "psnr": psnr,
            "cores": os.cpu_count(), "instruction_set": instruction_set(CPU)}


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measured(sys.argv[1])))
        sys.exit()
    rows = []
    for name in METHODS:
        own = [row(name, spins, busy) for busy in (0, 1) for spins in SPINS]
        rows += [line | {"ratio": line["seconds"] / own[0]["seconds"]} for line in own]
        print(*rows[-len(own):], sep="\n", flush=True)
    write_csv(Path(__file__).with_suffix(".csv"), rows)
