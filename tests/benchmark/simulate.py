"""What realistic X-rays cost: reconstructions from ideal and from polychromatic X-rays of the same CTs.

    python tests/benchmark/simulate.py <folder of CTs> [more infer.py arguments]

Runs `infer.py test` once per preset and simulator, with X-rays made at 3 mm; writes simulate.csv beside this file.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from phydict.evaluation import read_csv, rich_table, write_csv

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PRESETS = ("phydict_fast", "sirt")
SIMULATORS = {"ideal": ("ideal",), "polychromatic": ("polychromatic",),
              "polychromatic + scatter": ("polychromatic", "--data.simulator.scatter=0.06")}
"""Name -> configuration in configs/simulate, and what is changed of it: scatter as behind an antiscatter grid."""

if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give the folder of CTs: python tests/benchmark/simulate.py <folder>")
    rows = []
    with tempfile.TemporaryDirectory() as out:
        for name, (config, *changes) in SIMULATORS.items():
            for preset in PRESETS:
                method = f"{preset}, {name}"
                subprocess.run(
                    [sys.executable, "infer.py", "test", "-c", f"configs/reconstruct/{preset}.yaml", "-c",
                     f"configs/simulate/{config}.yaml", "--data.cts", sys.argv[1], "--data.simulation_voxels", "128",
                     "--model.out", out, "--model.name", method, *changes, *sys.argv[2:]], cwd=ROOT, check=True)
                rows += read_csv(Path(out) / method / "results.csv")
    write_csv(HERE / "simulate.csv", [{key: value for key, value in row.items() if key != "seconds"} for row in rows])
    Console(width=160).print(rich_table(rows))
