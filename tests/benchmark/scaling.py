"""Held-out denoising error of trainings against the samples they have seen, at each noise level.

    python tests/benchmark/scaling.py [<name>=<the training's metrics.csv>[+<samples seen before it>] ...]

Writes scaling.csv beside this file, where other trainings' rows stay: RMSE of the CT in HU and the PSNR of phydict_fast
as validation logged them, and of the base priors that were shipped one after another the mean RMSE of prior.csv's CTs;
and of the former scaling.png, on logarithmic axes, where a power law is a straight line.
"""

import argparse
from pathlib import Path
from statistics import mean

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from phydict.evaluation import read_csv, write_csv
from phydict.training.denoising import NOISE_LEVELS

FILE = Path(__file__)
SHIPPED = {"first": 17_200, "second": 21_800, "fifth": 27_400, "phydict_64": 55_400}
"""Names in prior.csv -> samples seen."""


def curve(name: str, log: Path, before: int) -> list[dict]:
    """One row for each validation of a training and each noise level."""
    rows = [row for row in read_csv(log) if row.get("val/rmse_hu") is not None]
    return [{"training": name, "samples": before + row["samples"], "t": t,
             "rmse_hu": row[f"val/rmse_hu_t{t}"], "psnr": row.get("val/psnr")}
            for row in rows for t in NOISE_LEVELS]


def shipped() -> list[dict]:
    """The same rows of the priors that were shipped, over the CTs of prior.csv."""
    errors = [row for row in read_csv(FILE.with_name("prior.csv")) if not row["case"].startswith("phantom")]
    return [{"training": "shipped", "samples": samples, "t": t, "rmse_hu": mean(
        row["rmse_hu"] for row in errors if row["prior"] == name and row["t"] == t)}
            for name, samples in SHIPPED.items() for t in NOISE_LEVELS]


def plot(rows: list[dict], file: Path) -> None:
    """A panel for each noise level, a line for each training."""
    figure = Figure(figsize=(3 * len(NOISE_LEVELS), 3.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, t in zip(figure.subplots(1, len(NOISE_LEVELS)), NOISE_LEVELS):
        for name in dict.fromkeys(row["training"] for row in rows):
            own = [row for row in rows if row["training"] == name and row["t"] == t]
            axes.loglog([row["samples"] for row in own], [row["rmse_hu"] for row in own], ".-", label=name)
        axes.set_title(f"t = {t}")
        axes.set_xlabel("samples seen")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("held-out RMSE (HU)")
    figure.axes[0].legend()
    figure.savefig(file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trainings", nargs="*", metavar="name=metrics.csv+before")
    given = parser.parse_args()
    if not all("=" in training for training in given.trainings):
        parser.error("a training is given as <name>=<its metrics.csv>")
    rows = read_csv(FILE.with_suffix(".csv"))
    for told in given.trainings:
        name, _, log = told.partition("=")
        log, _, before = log.partition("+")
        rows = [row for row in rows if row["training"] != name] + curve(name, Path(log), int(before or 0))
    rows = [row for row in rows if row["training"] != "shipped"] + shipped()
    write_csv(FILE.with_suffix(".csv"), rows)
    plot(rows, FILE.with_suffix(".png"))
