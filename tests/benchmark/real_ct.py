"""Every preset on a folder of real CTs: eight simulated X-rays each, scores and seconds side by side.

    python tests/benchmark/real_ct.py <folder of CTs> [more infer.py arguments]

Runs `infer.py test` once per preset and writes real_ct.csv beside this file. Where LPIPS' trained backbone is not
on the machine, phydict_paper runs with LPIPS weight 0 and its row is named so.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from phydict.evaluation import read_csv, rich_table, write_csv
from phydict.posterior.reward import load_lpips

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
WITHOUT_LPIPS = ("--model.method.init_args.likelihood.init_args.reward.lpips", "0",
                 "--model.name", "phydict_paper (LPIPS 0)")


def presets() -> dict[str, tuple[str, ...]]:
    """Preset name -> extra arguments."""
    try:
        load_lpips("vgg", False)
        paper = ()
    except FileNotFoundError as error:
        print(error)
        paper = WITHOUT_LPIPS
    return {"phydict_fast": (), "sirt": (), "prior_only": (), "phydict_paper": paper}


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give the folder of CTs: python tests/benchmark/real_ct.py <folder>")
    rows = []
    with tempfile.TemporaryDirectory() as out:
        for preset, extra in presets().items():
            subprocess.run([sys.executable, "infer.py", "test", "-c", f"configs/reconstruct/{preset}.yaml",
                            "--data.cts", sys.argv[1], "--model.out", out, *extra, *sys.argv[2:]], cwd=ROOT, check=True)
        for table in sorted(Path(out).glob("*/results.csv")):
            rows += read_csv(table)
    write_csv(HERE / "real_ct.csv", rows)
    Console().print(rich_table(rows))
