"""What a prior should learn from: CTs, a population drawn of them, other surroundings, phantoms; by unseen patients.

    python tests/benchmark/mixing.py <folder of CTs> <prior of phantoms alone> --left_out <CT> <CT> [--recipes ...]

Each recipe continues from the same prior, which has seen no CT, with the same number of draws of all patients but those
left out. One that was stopped resumes from its last checkpoint in --out, one that ended is not trained again.

Writes mixing.csv beside this file, a row per recipe, left-out CT, number of ideal views and draw: scores of
phydict_fast on the CT as it is (draw 0) and as other scans would show it (held_out.py). Prints what each recipe gains
on the first, with standard errors over CTs and draws.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from held_out import rows_of, table

from phydict.datasets import find_cts
from phydict.evaluation import read_csv, write_csv
from phydict.prior import load_prior
from phydict.training.stage import CHECKPOINT

FILE = Path(__file__).with_suffix(".csv")
ROOT = Path(__file__).parents[2]
SURROUNDINGS = {"table": 0.6, "cover": 0.12, "leads": 0.1, "arms": 0.1, "field": 0.15, "ends": 0.1}
EVERYTHING = {"data.loading.ct_fraction": 0.85, "data.loading.population.share": 0.4, "data.augmentation.girth": 0.1,
              **{f"data.augmentation.surroundings.{kind}": share for kind, share in SURROUNDINGS.items()}}
RECIPES = {
    "everything": {},
    "without surroundings": {"data.augmentation.girth": 0.0,
                             **{f"data.augmentation.surroundings.{kind}": 0.0 for kind in SURROUNDINGS}},
    "without population": {"data.loading.population.share": 0.0},
    "without phantoms": {"data.loading.ct_fraction": 1.0},
}


def trained(recipe: str, initial: str, cts: str, left_out: list[str], steps: int, out: Path) -> Path:
    """The file of a prior that went on from `initial` for `steps` steps of two draws."""
    last, file = out / CHECKPOINT, out / "prior.safetensors"
    if not file.exists():
        settings = {"out": out, "model.initial": initial, "model.text.pretrain_steps": 0,
                    "model.optimisation.learning_rate": 8e-4, "model.optimisation.warmup": 30,
                    "model.optimisation.decay_from": steps // 3, "model.optimisation.decay_steps": steps - steps // 3,
                    "data.cts": cts, "data.holdout.ids": f"[{','.join(left_out)}]", "data.phantoms": 400,
                    "data.loading.population.draws": 300, "data.augmentation.elastic_mm": 2.5,
                    "data.loading.batch_size": 2, "data.loading.epoch_size": 400, "trainer.max_steps": steps,
                    "trainer.limit_val_batches": 0, "trainer.callbacks.decay": 0.99, "trainer.accelerator": "cpu",
                    "trainer.devices": 1} | EVERYTHING | RECIPES[recipe]
        if last.exists():
            settings["ckpt_path"] = last
        subprocess.run([sys.executable, "train.py", "fit", "-c", "configs/prior/phantom.yaml",
                        *(f"--{name}={value}" for name, value in settings.items())], cwd=ROOT, check=True)
        subprocess.run([sys.executable, "train.py", "export", f"--checkpoint={last}", f"--out={file}"], cwd=ROOT,
                       check=True)
    return file


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cts", type=Path, help="folder of CTs, one of each patient")
    parser.add_argument("initial", type=Path, help="prior of phantoms alone")
    parser.add_argument("--left_out", nargs="+", required=True, help="the CTs that are left out together")
    parser.add_argument("--recipes", nargs="+", choices=RECIPES, default=list(RECIPES), metavar="NAME",
                        help=", ".join(RECIPES))
    parser.add_argument("--steps", type=int, default=1900, help="of two draws each")
    parser.add_argument("--views", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--changed", type=int, default=3, help="draws of each left-out CT")
    parser.add_argument("--out", type=Path, default=Path("runs/mixing"), help="checkpoints and priors")
    given = parser.parse_args()
    priors = {recipe: load_prior(trained(recipe, str(given.initial.resolve()), str(given.cts.resolve()), given.left_out,
                                         given.steps, given.out.resolve() / f"{recipe}, {', '.join(given.left_out)}"))
              for recipe in given.recipes}
    new = [row for ct in find_cts(given.cts) if ct.id in given.left_out
           for row in rows_of(ct, priors, "phydict_fast", given.views, given.changed)]
    kept = [row for row in read_csv(FILE) if row["weights"] not in priors or row["case"] not in given.left_out]
    write_csv(FILE, kept + new)
    print(table([row for row in kept + new if row["weights"] in priors]))
