"""Every preset on a folder of real CTs: eight simulated X-rays each, scores and seconds side by side.

    python tests/benchmark/real_ct.py <folder of CTs> [more infer.py arguments]

Runs `infer.py test` once per preset; writes real_ct.csv beside this file and data/pictures/real_ct.png of the first CT.
Where LPIPS' trained backbone is not on the machine, phydict_paper runs with LPIPS weight 0 and its rows are named so.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel
from rich.console import Console

from phydict import HUWindow
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import method_panel, read_csv, rich_table, write_csv
from phydict.grid import Grid
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
    return {"phydict_fast": (), "sirt": (), "phydict_paper": paper, "prior_only": ()}


def picture(cts: str, out: Path, rows: list[dict]) -> None:
    """The first CT and its reconstructions by all methods, with their scores."""
    case = find_cts(cts)[0]
    grid, own = Grid.cube(64), [row for row in rows if row["case"] == case.id]
    truth = HUWindow().to_hu(prepare_ct(case.path, grid)["volume"][0])
    volumes = {row["method"]: nibabel.load(out / row["method"] / case.id / "volume.nii.gz").get_fdata() for row in own}
    captions = {row["method"]: f"{row['psnr']:.1f} dB, SSIM {row['ssim']:.2f}, {row['seconds']:.1f} s" for row in own}
    method_panel(ROOT / "data" / "pictures" / "real_ct.png", volumes, truth, grid, captions)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give the folder of CTs: python tests/benchmark/real_ct.py <folder>")
    rows = []
    with tempfile.TemporaryDirectory() as out:
        for preset, extra in presets().items():
            subprocess.run([sys.executable, "infer.py", "test", "-c", f"configs/reconstruct/{preset}.yaml",
                            "--data.cts", sys.argv[1], "--model.out", out, *extra, *sys.argv[2:]], cwd=ROOT, check=True)
            name = WITHOUT_LPIPS[-1] if extra else preset
            rows += read_csv(Path(out) / name / "results.csv")
        write_csv(HERE / "real_ct.csv", rows)
        (ROOT / "data" / "pictures").mkdir(exist_ok=True)
        picture(sys.argv[1], Path(out), rows)
    Console(width=120).print(rich_table(rows))
