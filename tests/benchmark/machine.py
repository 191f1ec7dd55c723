"""What precision, instruction set, threads and a first call cost on this machine.

    python tests/benchmark/machine.py

Each row is a process of its own, on the CPU: one network call of the shipped prior at 64^3 (t = 0.1, with its detail
network), and of other shapes of the network, untrained; the default's reconstruction of the embedded example; a
training step of two phantoms. `limited` rows run with ONEDNN_MAX_CPU_ISA=AVX2 and ATEN_CPU_CAPABILITY=avx2, which keep
a newer processor from more than AVX2. `first` is a process' first time, for a reconstruction with numba's cache empty;
`seconds` is the fastest of the times after it.

Errors: of a network call, the root mean square in HU from float64; of a reconstruction, `psnr` (dB) against the CT that
the example's X-rays were made of; of a training step, the first loss. Writes machine.csv beside this file and leaves
the rows of other processors.
"""

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

AVX2 = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"}
SHAPES = {"24-48-96": (24, 48, 96), "32-64-128": (32, 64, 128), "32-64-128-128": (32, 64, 128, 128),
          "16-48-128": (16, 48, 128)}
"""Widths of the network's levels; attention in the deepest."""
REPEATS = 3


def timed(work, repeats: int) -> tuple[float, float | None, object]:
    """Seconds of the first time, of the fastest of `repeats` more, and what came out."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        found = work()
        seconds.append(time.perf_counter() - began)
    return seconds[0], min(seconds[1:], default=None), found


def network_call(precision: str, repeats: int, channels: tuple[int, ...] | None) -> dict:
    import torch

    from phydict.prior import DetailNetwork, Prior, VolumeUNet, load_prior
    from phydict.prior.files import DEFAULT_PRIOR

    prior = load_prior(DEFAULT_PRIOR)
    torch.manual_seed(0)
    if channels is not None:
        network = VolumeUNet(channels=channels, attention=(False,) * (len(channels) - 1) + (True,))
        prior = Prior(network, prior.grid, prior.window, detail=DetailNetwork()).eval().requires_grad_(False)
    x = torch.randn(1, prior.state_channels, *prior.grid.shape)
    first, seconds, found = timed(lambda: prior.bind(precision=precision).denoise(x, 0.1), repeats)
    exact = prior.double().bind().denoise(x.double(), 0.1)
    error = (found - exact)[:, 0].square().mean().sqrt() * prior.window.half_width
    return {"first": first, "seconds": seconds, "rms_hu": None if channels else float(error)}


def reconstruction(precision: str, repeats: int) -> dict:
    import nibabel
    import torch

    import phydict
    from phydict.evaluation import volume_metrics
    from phydict.prior import DEFAULT_PRIOR

    here = Path(__file__).parents[2] / "data" / "example"
    case, prior = phydict.load_xrays(here / "xrays"), phydict.load_prior(DEFAULT_PRIOR)
    truth = torch.from_numpy(nibabel.load(here / "truth.nii.gz").get_fdata(dtype="float32"))[None, None]
    first, seconds, found = timed(lambda: phydict.reconstruct(
        case["xrays"], case["beam"], prior, report=case["report"], precision=precision), repeats)
    return {"first": first, "seconds": seconds, "psnr": volume_metrics(found.volume[None, None], truth)["psnr"]}


def training_step(precision: str, repeats: int) -> dict:
    from torch.utils.data import DataLoader
    from training import BATCH, STEPS, WARM_UP, example_cases, our_steps

    from phydict.runtime.console import quiet

    with quiet():
        clock = our_steps(DataLoader(example_cases() * (STEPS + WARM_UP), BATCH),
                          "bf16-mixed" if precision == "bfloat16" else "32-true")
    return {"first": clock.seconds[0], "seconds": min(clock.seconds[WARM_UP:]), "loss": clock.losses[0]}


def measure(what: str, precision: str, threads: int, repeats: int) -> dict:
    """One row, in this process."""
    import torch

    from phydict.runtime.precision import instruction_set

    torch.set_num_threads(threads)
    kind, _, shape = what.partition(", ")
    if kind == "network call":
        found = network_call(precision, repeats, SHAPES.get(shape))
    else:
        found = {"reconstruction": reconstruction, "training step": training_step}[kind](precision, repeats)
    return {"measured": what, "processor": processor(), "instruction_set": instruction_set(torch.device("cpu")),
            "precision": precision, "threads": threads} | found


def processor() -> str:
    """What the system calls its processor."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text()) if sys.platform == "linux" else []
    return names[0] if names else platform.processor()


def in_a_process(what: str, precision: str, threads: int, limited: bool) -> dict:
    """One row, from a process of its own with an empty cache of compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        settings = {"NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
        done = subprocess.run([sys.executable, __file__, what, precision, str(threads), str(REPEATS)], check=True,
                              env=os.environ | settings | (AVX2 if limited else {}), stdout=subprocess.PIPE, text=True)
    row = json.loads(done.stdout.splitlines()[-1])
    row["limited"] = limited
    print(row, flush=True)
    return row


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))))
        sys.exit()
    from phydict.evaluation import read_csv, write_csv

    file, rows = Path(__file__).with_suffix(".csv"), []
    for what, threads, (limited, precision) in product(
            ("network call", "reconstruction", "training step"), (1, 2),
            ((False, "bfloat16"), (False, "float32"), (True, "float32"))):
        rows.append(in_a_process(what, precision, threads, limited))
    for shape, (limited, precision) in product(SHAPES, ((False, "bfloat16"), (True, "float32"))):
        rows.append(in_a_process(f"network call, {shape}", precision, 2, limited))
    write_csv(file, [row for row in read_csv(file) if row["processor"] != rows[0]["processor"]] + rows)
