"""Phantoms, CTs or both: which share of CTs a prior should learn from, by the CTs of patients that it has not seen.

    python tests/benchmark/mixing.py <folder of training CTs> <prior of phantoms alone> [--out runs/mixing]

The CTs, one of each patient, are left out in turn, --leave at a time. Each turn starts from the same prior, which has
seen no CT, with the same number of draws, of which a share is from the CTs that are not left out; without any one
training serves all turns. One that was stopped resumes from its last checkpoint in --out, one whose rows mixing.csv
holds is not run again.

Writes mixing.csv beside this file, one row per share of CTs, left-out CT and number of ideal views: denoising error
(RMSE of the CT in HU) at each noise level, and SSIM, PSNR and MAE of phydict_fast's reconstruction.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from designs import scores

from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import read_csv, write_csv
from phydict.prior import load_prior
from phydict.training.stage import CHECKPOINT

FILE = Path(__file__).with_suffix(".csv")
ROOT = Path(__file__).parents[2]
VIEWS = (2, 4, 8)


def trained(initial: str, cts: str, left_out: list[str], fraction: float, steps: int, out: Path) -> Path:
    """The file of a prior that went on from `initial` for `steps` steps of two draws."""
    last, file = out / CHECKPOINT, out / "prior.safetensors"
    if not file.exists():
        settings = {"out": out, "model.initial": initial, "model.text.pretrain_steps": 0,
                    "model.optimisation.learning_rate": 1e-3, "model.optimisation.warmup": 30,
                    "model.optimisation.decay_from": steps // 2, "model.optimisation.decay_steps": steps - steps // 2,
                    "data.cts": cts, "data.holdout.ids": f"[{','.join(left_out)}]",
                    "data.loading.ct_fraction": fraction, "data.loading.batch_size": 2, "data.loading.epoch_size": 100,
                    "trainer.max_steps": steps, "trainer.limit_val_batches": 0, "trainer.callbacks.decay": 0.98,
                    "trainer.accelerator": "cpu", "trainer.devices": 1} | ({"ckpt_path": last} if last.exists() else {})
        subprocess.run([sys.executable, "train.py", "fit", "-c", "configs/prior/phantom.yaml",
                        *(f"--{name}={value}" for name, value in settings.items())], cwd=ROOT, check=True)
        subprocess.run([sys.executable, "train.py", "export", f"--checkpoint={last}", f"--out={file}"], cwd=ROOT,
                       check=True)
    return file


def parser() -> argparse.ArgumentParser:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("cts", help="folder of training CTs")
    arguments.add_argument("initial", help="prior of phantoms alone")
    arguments.add_argument("--out", type=Path, default=Path("runs/mixing"), help="checkpoints and priors")
    arguments.add_argument("--fractions", nargs="*", type=float, default=[0.0, 0.5, 1.0])
    arguments.add_argument("--leave", type=int, default=2, help="CTs left out at a time")
    arguments.add_argument("--steps", type=int, default=200, help="of two draws each")
    return arguments


if __name__ == "__main__":
    given = parser().parse_args()
    files = {file.id: file.path for file in find_cts(given.cts)}
    ids = list(files)
    for fraction in given.fractions:
        leave = given.leave if fraction else len(ids)
        for left_out in (ids[i:i + leave] for i in range(0, len(ids), leave)):
            told = {"ct_fraction": fraction, "draws": 2 * given.steps}
            if {row["case"] for row in read_csv(FILE) if told.items() <= row.items()} >= set(left_out):
                continue
            out = given.out.resolve() / f"{fraction:g}, {left_out[0]}"
            prior = load_prior(trained(str(Path(given.initial).resolve()), str(Path(given.cts).resolve()), left_out,
                                       fraction, given.steps, out))
            cases = [prepare_ct(files[id], prior.grid, prior.window, id=id) for id in left_out]
            new = [told | {"views": views} | row for views in VIEWS for row in scores(prior, cases, views)]
            write_csv(FILE, read_csv(FILE) + new)
            print(told, left_out, flush=True)
