"""Memory and time of one call of MedSyn's full-size denoisers, with random weights, in bfloat16 on the CPU.

    python tests/benchmark/medsyn.py [width of stage 1] [width of stage 2]

Writes medsyn.csv beside this file: stage 1 on its 64^3 voxels; stage 2 on 128^3 of its 256^3. Each stage runs in a
process of its own, whose greatest memory includes Python, torch and the weights in float32.
"""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import torch

from phydict.evaluation import write_csv
from phydict.prior.medsyn.networks import SuperResolutionUNet, TextUNet
from phydict.prior.medsyn.prior import MedSynPrior
from phydict.prior.medsyn.super_resolution import MedSynSuperResolution

WIDTHS, VOXELS = {1: 160, 2: 56}, {1: 64, 2: 128}


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(stage: int, width: int) -> dict:
    """One call of a stage of the given width."""
    with torch.device("meta"):
        network = TextUNet(width) if stage == 1 else SuperResolutionUNet(width)
    network = network.to_empty(device="cpu").eval().requires_grad_(False)
    for weight in network.parameters():
        weight.normal_(0, 0.02)
    n = VOXELS[stage]
    if stage == 1:
        denoiser = MedSynPrior(network).bind(precision="bfloat16")
    else:
        denoiser = MedSynSuperResolution(network).bind(torch.zeros(1, 4, n // 4, n // 4, n // 4), precision="bfloat16")
    weights = peak_mib()
    x = torch.randn(1, 4, n, n, n)
    start = time.perf_counter()
    denoiser.denoise(x, 0.5)
    seconds = time.perf_counter() - start
    return {"stage": stage, "parameters": sum(weight.numel() for weight in network.parameters()), "voxels": n**3,
            "precision": "bfloat16", "threads": torch.get_num_threads(), "peak_mib_before_the_call": round(weights),
            "peak_mib": round(peak_mib()), "seconds": round(seconds, 2)}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--stage"]:
        print(json.dumps(measure(int(sys.argv[2]), int(sys.argv[3]))))
    else:
        widths = [int(width) for width in sys.argv[1:]] or list(WIDTHS.values())
        rows = []
        for stage, width in enumerate(widths, 1):
            done = subprocess.run([sys.executable, __file__, "--stage", str(stage), str(width)], check=True,
                                  capture_output=True, text=True)
            rows.append(json.loads(done.stdout.splitlines()[-1]))
            print(rows[-1])
        write_csv(Path(__file__).with_suffix(".csv"), rows)
