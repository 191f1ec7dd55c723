"""Times the projectors against DiffDRR's Siddon renderer on the same rays and volume, and writes projector.csv.

    OMP_WAIT_POLICY=PASSIVE python tests/benchmark/projector.py --threads 1 2

Work: a 64^3 volume over 250 mm, 8 views of 128^2 pixels of 3.5 mm, source to isocentre 800 mm and to detector 1020 mm,
float32; medians of `--repeats` runs, interleaved. DiffDRR (`pip install phydict[benchmark]`) may be missing: then its
rows and the ratios are left out. Relative errors are against float64 references of the same volume model.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from phydict.xray import ConeBeam, Grid, Projector

COLUMNS = ("method", "forward_s", "forward_backward_s", "ratio_to_diffdrr_siddon", "relative_error", "reference",
           "adjoint_mismatch", "threads", "torch")
STRIDE = 5  # the trilinear reference is computed on every fifth row and column


def body(grid: Grid) -> torch.Tensor:
    """A trunk with two lungs, a spine and texture, in 1/mm: (1, 1, X, Y, Z)."""
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), -1)
    at = (index @ grid.affine[:3, :3].T + grid.affine[:3, 3]) / grid.extent * 2
    inside = [(((at - centre) / radii) ** 2).sum(-1) < 1 for centre, radii in (
        ((0, 0, 0), (0.9, 0.65, 2.0)), ((0.4, 0, 0.1), (0.32, 0.45, 0.75)), ((-0.4, 0, 0.1), (0.3, 0.45, 0.7)),
        ((0, -0.45, 0), (0.12, 0.12, 2.0)))]
    mu = 0.02 * inside[0] - 0.016 * (inside[1] | inside[2]) + 0.012 * inside[3]
    texture = gaussian_filter(np.random.default_rng(0).normal(size=grid.shape), 1.0)
    return torch.as_tensor(np.where(inside[0], mu * (1 + texture), 0))[None, None].clamp_min(0)


def trilinear(mu: torch.Tensor, grid: Grid, beam: ConeBeam) -> torch.Tensor:
    """Line integrals of the trilinear interpolant on every STRIDE-th row and column, by 4000 samples per ray."""
    pixels = beam.pixels()[:, ::STRIDE, ::STRIDE]
    source = beam.sources[:, None, None]
    reach = np.linalg.norm(grid.extent) / 2 + max(grid.spacing)
    length = np.linalg.norm(pixels - source, axis=-1)
    middle = np.linalg.norm(beam.sources - grid.centre, axis=1)[:, None, None]
    total, samples = np.zeros(length.shape), 4000
    for k in range(samples):
        way = middle + reach * 1.1 * ((k + 0.5) / samples * 2 - 1)
        point = grid.index(source + (pixels - source) * (way / length)[..., None])
        total += map_coordinates(mu[0, 0].numpy(), np.moveaxis(point, -1, 0), order=1, mode="grid-constant")
    return torch.as_tensor(total * 2 * reach * 1.1 / samples)[None]


def diffdrr_siddon(grid: Grid, beam: ConeBeam):
    """DiffDRR's Siddon renderer on our rays, one view per call; None where DiffDRR is not installed."""
    try:
        from diffdrr.renderers import Siddon
    except ImportError as error:
        print(f"DiffDRR cannot be imported ({error}); its row and the ratios are left empty")
        return None
    renderer, pixels = Siddon(), beam.pixels().reshape(beam.views, -1, 3)
    source, target = grid.index(beam.sources)[:, None], grid.index(pixels)
    length = np.linalg.norm(pixels - beam.sources[:, None], axis=-1)[:, None]

    def render(mu: torch.Tensor) -> torch.Tensor:
        rays = [torch.as_tensor(part).to(mu) for part in (source, target, length)]
        views = [renderer(mu[0, 0], *[part[k:k + 1] for part in rays]) for k in range(beam.views)]
        return torch.cat(views, 1).reshape(1, beam.views, *beam.shape)

    return render


def gradient(project, mu: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, float, float]:
    """The gradient of <project(mu), y>, the seconds of the forward pass alone, and of both passes."""
    mu = mu.clone().requires_grad_()
    begin = time.perf_counter()
    with torch.no_grad():
        project(mu)
    middle = time.perf_counter()
    (result,) = torch.autograd.grad((project(mu) * y).sum(), mu)
    return result, middle - begin, time.perf_counter() - middle


def medians(methods: dict, mu: torch.Tensor, y: torch.Tensor, repeats: int) -> dict[str, np.ndarray]:
    """Median seconds (forward, forward and backward) per method; they take turns, after a round of warming up."""
    seconds = {name: [] for name in methods}
    for repeat in range(repeats + 1):
        for name, project in methods.items():
            _, *spent = gradient(project, mu, y)
            if repeat:
                seconds[name].append(spent)
    return {name: np.median(spent, axis=0) for name, spent in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    arguments = parser.parse_args()

    grid, beam = Grid.cube(64, 250), ConeBeam.orbit(8, 1020, 800, (128, 128), 3.5)
    exact = body(grid)
    mu, y = exact.float(), torch.rand(1, 8, 128, 128, generator=torch.Generator().manual_seed(1))
    methods = {name: Projector(grid, beam, name) for name in ("separable", "matrix", "siddon", "joseph", "eq4")}
    peer = diffdrr_siddon(grid, beam)
    if peer is not None:
        methods["DiffDRR Siddon"] = peer

    every = slice(None, None, STRIDE)
    boxes, smooth, midpoints = methods["siddon"](exact), trilinear(exact, grid, beam), methods["eq4"](exact)
    rows = []
    for threads in arguments.threads:
        torch.set_num_threads(threads)
        times = medians(methods, mu, y, arguments.repeats)
        for name, project in methods.items():
            image, back = project(mu).double(), gradient(project, mu, y)[0].double()
            if name in ("separable", "joseph"):
                error = (image[..., every, every] - smooth).norm() / smooth.norm()
                reference = "trilinear volume, 4000 samples per ray"
            elif name == "eq4":
                error = (image - midpoints).norm() / midpoints.norm()
                reference = "the paper's Eq. 4, phydict eq4 float64"
            else:
                error = (image - boxes).norm() / boxes.norm()
                reference = "piecewise-constant voxels, phydict siddon float64"
            left, right = (image * y.double()).sum(), (mu.double() * back).sum()
            ratio = f"{times['DiffDRR Siddon'][1] / times[name][1]:.1f}" if peer is not None else ""
            rows.append((name, *(f"{t:.4f}" for t in times[name]), ratio, f"{error:.1e}", reference,
                         f"{abs(left - right) / abs(left):.1e}", threads, torch.__version__))
    with arguments.out.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    for row in (COLUMNS, *rows):
        print("  ".join(map(str, row)))


if __name__ == "__main__":
    main()
