"""The README's picture: a real CT and what four methods make of eight simulated X-rays of it.

    python tests/benchmark/picture.py <CT>

Runs `infer.py test` once per preset; writes data/pictures/real_ct.png. Where LPIPS' trained backbone is not on the
machine, phydict_paper runs with LPIPS weight 0 and is named so.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import nibabel

from phydict import HUWindow
from phydict.datasets import find_cts, prepare_ct
from phydict.evaluation import method_panel, read_csv
from phydict.grid import Grid
from phydict.posterior.likelihood.reward import load_lpips

ROOT = Path(__file__).parents[2]
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
    return {"phydict_fast": (), "tv": (), "sirt": (), "phydict_paper": paper}


def picture(ct: str, out: Path, rows: list[dict]) -> None:
    """The CT and its reconstructions by all methods, with their scores."""
    case, grid = find_cts(ct)[0], Grid.cube(64)
    truth = HUWindow().to_hu(prepare_ct(case.path, grid)["volume"][0])
    volumes = {row["method"]: nibabel.load(out / row["method"] / case.id / "volume.nii.gz").get_fdata() for row in rows}
    captions = {row["method"]: f"{row['psnr']:.1f} dB, SSIM {row['ssim']:.2f}, {row['seconds']:.1f} s" for row in rows}
    method_panel(ROOT / "data" / "pictures" / "real_ct.png", volumes, truth, grid, captions)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("give a CT: python tests/benchmark/picture.py <CT>")
    rows = []
    with tempfile.TemporaryDirectory() as out:
        for preset, extra in presets().items():
            subprocess.run([sys.executable, "infer.py", "test", "--model.method", preset,
                            "--data.cts", sys.argv[1], "--model.out", out, *extra], cwd=ROOT, check=True)
            rows += read_csv(Path(out) / (WITHOUT_LPIPS[-1] if extra else preset) / "results.csv")
        picture(sys.argv[1], Path(out), rows)
