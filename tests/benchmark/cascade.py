"""What a super-resolution stage adds: reconstructions of CTs on its fine grid, from eight X-rays made there.

    python tests/benchmark/cascade.py <super-resolution stage> <folder of CTs> [more infer.py arguments]

Runs `infer.py test` with the base prior alone, with the second stage unguided, and guided; the base prior's volumes are
upsampled trilinearly and scored on the fine grid too. Writes cascade.csv beside this file.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel
import torch
from rich.console import Console
from torch.nn.functional import interpolate

from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import read_csv, rich_table, volume_metrics, write_csv
from phydict.prior import load_super_resolution

HERE = Path(__file__).parent
ROOT = HERE.parents[1]

if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit("give both: python tests/benchmark/cascade.py <super-resolution stage> <folder of CTs>")
    stage, cts, *more = sys.argv[1:]
    fine, rows = load_super_resolution(stage), []
    runs = {"upsampled": [f"--data.simulation_voxels={fine.grid.shape[0]}"],
            "cascade, unguided": [f"--model.super_resolution={stage}", "--model.guide_fine=false"],
            "cascade, guided": [f"--model.super_resolution={stage}"]}
    with tempfile.TemporaryDirectory() as out:
        for name, arguments in runs.items():
            subprocess.run([sys.executable, "infer.py", "test", "-c", "configs/reconstruct/phydict_fast.yaml",
                            f"--data.cts={cts}", f"--model.out={out}", f"--model.name={name}", *arguments, *more],
                           cwd=ROOT, check=True)
            scores = {row["case"]: row for row in read_csv(Path(out) / name / "results.csv")}
            for ct in find_cts(cts):
                case = Path(out) / name / ct.id
                record = json.loads((case / "reconstruction.json").read_text())
                row = scores[ct.id] | {"peak_memory_mb": record["process_peak_memory_mb"]}
                if name == "upsampled":
                    truth = prepare_ct(ct.path, fine.grid, fine.window, id=ct.id)
                    volume = torch.from_numpy(nibabel.load(case / "volume.nii.gz").get_fdata().astype("float32"))
                    volume = interpolate(volume[None, None], fine.grid.shape, mode="trilinear")
                    row |= volume_metrics(volume, fine.window.to_hu(truth["volume"])[None], truth["masks"][None, :1])
                rows.append(row)
    write_csv(HERE / "cascade.csv", rows)
    Console(width=160).print(rich_table(rows))
