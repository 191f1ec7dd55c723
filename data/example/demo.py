"""Reconstructs the example by three methods and compares them with the CT its X-rays were made of.

    python data/example/demo.py
"""

from pathlib import Path

import phydict  # before torch, whose threads then wait less beside others

# isort: split
import nibabel
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from phydict.datasets import body_mask, load_xrays
from phydict.evaluation import mean_table, method_panel, panel, volume_metrics, write_csv
from phydict.inference.case_files import write_page_files
from phydict.page import Contents, PageCase, write_page
from phydict.page.case_files import THUMBNAIL

METHODS = ("phydict_learned", "phydict_fast", "sirt")

if __name__ == "__main__":
    here, out = Path(__file__).parent, Path("runs/demo")
    case = load_xrays(here / "xrays")
    truth = torch.from_numpy(nibabel.load(here / "truth.nii.gz").get_fdata(dtype="float32"))
    grid = phydict.Grid.cube(truth.shape[0])
    body = torch.from_numpy(body_mask(truth.numpy(), grid.spacing))[None, None]
    out.mkdir(parents=True, exist_ok=True)
    rows, volumes, shown = [], {}, []
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()) as bar:
        for method in METHODS:
            steps = bar.add_task(method, total=phydict.METHODS[method].steps())
            result = phydict.reconstruct(case["xrays"], case["beam"], method=method, on_step=lambda: bar.advance(steps))
            scores = volume_metrics(result.volume[None, None], truth[None, None], body=body)
            known = {"case": "example", "method": method, "views": len(case["xrays"])}
            rows.append(known | {"grid": "64x64x64"} | scores
                        | {"misfit": result.misfit, "seconds": sum(result.seconds.values())})
            volumes[method] = result.volume
            result.save_nifti(out / f"{method}.nii.gz")
            (out / method).mkdir(exist_ok=True)
            write_page_files(out / method, result, truth)
            shown.append(PageCase(method, [THUMBNAIL], known | {
                "scores": scores, "misfit": result.misfit, "misfit_per_view": result.misfit_per_view,
                "seconds": result.seconds, "grid": grid.to_dict(), "warnings": result.warnings,
                "report": case["report"]}))
            panel(out / f"{method}.png", result.volume, result.grid, result.xrays, result.reprojection, truth,
                  title=f"{method}, {len(case['xrays'])} X-rays")
    captions = {row["method"]: f"{row['psnr']:.1f} dB, SSIM {row['ssim']:.2f}" for row in rows}
    method_panel(out / "comparison.png", volumes, truth, grid, captions)
    write_csv(out / "results.csv", rows)
    table = mean_table(rows)
    Console().print(table)
    page = write_page(out, Contents("The embedded example", [table], shown, plots=["comparison.png"],
                                    links=[*(f"{method}.nii.gz" for method in METHODS), "results.csv"]))
    print(f"page, for a browser: {page}\npicture: {out / 'comparison.png'}\nvolumes, X-ray fits and results.csv: {out}")
