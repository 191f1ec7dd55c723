"""Seconds, peak memory and error on a GPU: the projector, a network call, reconstructions.

    python tests/benchmark/cuda.py [--seconds 50] [--largest 256] [--views 2 8 32] [--device cuda] [--out cuda.csv]

Rows, `what` and its `error` or `psnr`:
    forward, adjoint: of the projector that "auto" takes, on a cube of 250 mm, the geometry of projector.py; medians.
        Errors are relative: of two images to analytic Gaussian blobs, and of <A x, y> to <x, A'y>.
    denoise: a call of the shipped prior at t = 0.1 with its detail network, a batch of one; the median. The error is
        the relative one of the CT to the same call in float64.
    phydict_fast, phydict_learned: a reconstruction from ideal X-rays made on the voxels of the result, on the
        benchmarks' orbit, end to end with the tables of its geometry, once after one from WARM_UP views. psnr (dB) is
        that of a phantom in the range of 2000 HU; on 256^3 voxels the phantom is interpolated from 128^3.

gib is the peak of the tensors on the device (on a CPU, of the process). No row begins after --seconds. What fails is
told on stderr and has no row. Writes the CSV after each row and leaves the rows of other devices.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache, partial
from pathlib import Path

sys.path.append(sys.path.pop(0))  # this file's folder comes last, where its name hides no package of CUDA's

import exact
import numpy as np
import torch
from torch import Tensor

from phydict.datasets import phantom_case
from phydict.evaluation import RANGE, read_csv, write_csv
from phydict.grid import Grid
from phydict.methods import reconstruct
from phydict.prior import DEFAULT_PRIOR, DEFAULT_REFINER, load_prior
from phydict.runtime.precision import instruction_set
from phydict.runtime.profiling import peak_memory, reset_peak_memory
from phydict.units import AIR, HUWindow
from phydict.xray import ConeBeam, Ideal, Projector
from phydict.xray.binning import benchmark_orbit
from phydict.xray.boxes import interpolated

PIXELS = {64: 128, 128: 256, 256: 448}
"""Voxels along each side, and pixels along each side of the projector's detector."""

PRIORS = {"phydict_fast": DEFAULT_PRIOR, "phydict_learned": DEFAULT_REFINER}

WARM_UP = 3
"""Views of a reconstruction before the ones that are timed, which have others, and so tables of their own to make."""

REPEATS, LONG = 10, 0.5
"""Of short work: how often it is timed at most, and the seconds after which it is not timed again."""

DENOISED_AT = 0.1

WINDOW = HUWindow()


def seconds_of(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of a call, until the device has done its work."""
    if device.type != "cuda":
        began = time.perf_counter()
        work()
        return time.perf_counter() - began
    torch.cuda.synchronize(device)
    began, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    began.record()
    work()
    ended.record()
    ended.synchronize()
    return began.elapsed_time(ended) / 1000


def median_of(work: Callable[[], object], device: torch.device) -> float:
    """Median seconds of some calls, after two that warm up."""
    for _ in range(2):
        work()
    taken: list[float] = []
    while len(taken) < REPEATS and sum(taken) < LONG:
        taken.append(seconds_of(work, device))
    return float(np.median(taken))


def gib(device: torch.device) -> float:
    return peak_memory(device) / 1024


@cache
def blobs(voxels: int) -> Tensor:
    """Attenuation (1, 1, X, Y, Z) of Gaussian blobs."""
    return torch.as_tensor(exact.blobs(Grid.cube(voxels, 250)), dtype=torch.float32)[None, None]


def projections(voxels: int, views: int, device: torch.device) -> list[dict]:
    pixels = PIXELS[voxels]
    beam = ConeBeam.orbit(views, 1020, 800, (pixels, pixels), 448 / pixels, start=0.2)
    A = Projector(Grid.cube(voxels, 250), beam, device=device, full_detector=True)
    x = blobs(voxels).to(device)
    y = torch.rand(1, views, pixels, pixels, generator=torch.Generator().manual_seed(1)).to(device)
    rows, found = [], {}
    for what, work in (("forward", lambda: found.update(image=A(x))), ("adjoint", lambda: found.update(back=A.T(y)))):
        reset_peak_memory(device)
        rows.append({"what": what, "voxels": voxels, "views": views, "precision": "float32",
                     "seconds": median_of(work, device), "gib": gib(device)})
    image, back = found["image"].double(), found["back"].double()
    true = exact.blob_integrals(beam.select([0, 1]))
    rows[0]["error"] = float(np.linalg.norm(image[0, :2].cpu().numpy() - true) / np.linalg.norm(true))
    rows[1]["error"] = float(((image * y).sum() / (x * back).sum() - 1).abs())
    return rows


@cache
def prior_of(method: str, device: torch.device):
    return load_prior(PRIORS[method]).to(device)


@torch.no_grad()
def denoising(precision: str, device: torch.device) -> list[dict]:
    prior = prior_of("phydict_fast", device)
    shape = 1, prior.state_channels, *prior.grid.shape
    x, found = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device), {}
    denoiser = prior.bind(precision=precision)
    reset_peak_memory(device)
    row = {"what": "denoise", "voxels": prior.grid.shape[0], "views": None, "precision": precision,
           "seconds": median_of(lambda: found.update(x0=denoiser.denoise(x, DENOISED_AT)), device), "gib": gib(device)}
    true = deepcopy(prior).double().bind(precision="float32").denoise(x.double(), DENOISED_AT)[:, 0]
    return [row | {"error": float((found["x0"][:, 0].double() - true).norm() / true.norm())}]


@cache
def phantom(voxels: int) -> Tensor:
    """HU (X, Y, Z)."""
    if voxels <= 128:
        return WINDOW.to_hu(phantom_case(3, Grid.cube(voxels), WINDOW)["volume"])[0]
    return interpolated(phantom(128), Grid.cube(128), Grid.cube(voxels), AIR)


def xrays(voxels: int, views: int, device: torch.device) -> tuple[Tensor, ConeBeam]:
    """Of the phantom (K, V, U), on the device, and their geometry."""
    grid = Grid.cube(voxels)
    beam, mu = benchmark_orbit(grid, views), WINDOW.to_mu(WINDOW.to_range(phantom(voxels)))
    A = Projector(grid, beam, device=device, full_detector=True)
    return Ideal()(A, mu.to(device)[None, None], 0)[0], beam


@cache
def warmed_up(method: str, voxels: int, device: torch.device) -> None:
    """Reconstructs once."""
    reconstruct(*xrays(voxels, WARM_UP, device), prior_of(method, device), method, grid=Grid.cube(voxels))


def reconstruction(method: str, voxels: int, views: int, device: torch.device) -> list[dict]:
    warmed_up(method, voxels, device)
    (y, beam), grid, found = xrays(voxels, views, device), Grid.cube(voxels), []
    reset_peak_memory(device)
    seconds = seconds_of(lambda: found.append(
        reconstruct(y, beam, prior_of(method, device), method, grid=grid)), device)
    peak, (result,) = gib(device), found
    return [{"what": method, "voxels": voxels, "views": views, "precision": result.precision, "seconds": seconds,
             "gib": peak, "psnr": psnr(result.volume, phantom(voxels))}]


def psnr(volume: Tensor, truth: Tensor) -> float:
    """As phydict.evaluation.volume_metrics has it, which would also take an SSIM on the CPU."""
    one, other = (hu.double().clamp(RANGE.low, RANGE.high) for hu in (volume, truth))
    return float(20 * np.log10(RANGE.high - RANGE.low) - 10 * (one - other).square().mean().log10())


def work_of(sizes: list[int], views: list[int], device: torch.device) -> Iterator[tuple[str, Callable[[], list[dict]]]]:
    """What is measured, by name, in the order of its worth."""
    for precision in ("bfloat16", "float32"):
        yield f"denoise, {precision}", partial(denoising, precision, device)
    for voxels in sizes:
        for count in views:
            yield f"projector, {voxels}^3, {count} views", partial(projections, voxels, count, device)
    for voxels in sizes:
        for count in views:
            for method in PRIORS:
                yield f"{method}, {voxels}^3, {count} views", partial(reconstruction, method, voxels, count, device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=50.0, help="no row begins after as many")
    parser.add_argument("--largest", type=int, choices=PIXELS, default=max(PIXELS), help="voxels along a side")
    parser.add_argument("--views", type=int, nargs="+", default=[2, 8, 32])
    parser.add_argument("--device", type=torch.device, default="cuda")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    given = parser.parse_args()
    began, name = time.monotonic(), instruction_set(given.device)
    rows = [row for row in read_csv(given.out) if row["device"] != name]
    columns = dict.fromkeys(("device", "what", "voxels", "views", "precision", "seconds", "gib", "psnr", "error"))
    for title, work in work_of([n for n in PIXELS if n <= given.largest], given.views, given.device):
        if time.monotonic() - began > given.seconds:
            print(f"{title} and what comes after it: left out after {given.seconds:g} s", file=sys.stderr)
            break
        try:
            made = work()
        except Exception:  # of whatever kind: the other rows go on
            print(f"{title}:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
            continue
        rows += [columns | {"device": name} | row for row in made]
        write_csv(given.out, rows)
        for row in made:
            print(*(f"{value:.6g}" if isinstance(value, float) else value for value in row.values()), flush=True)


if __name__ == "__main__":
    main()
