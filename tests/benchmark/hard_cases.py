"""Hard cases: what methods make of data and settings at the limits, and whether they say so.

    python tests/benchmark/hard_cases.py <CT> [words in the names of cases]

64^3 voxels of 6 mm; unless the case says otherwise, eight ideal views of 448 x 448 pixels with 0.5 % noise. Writes
hard_cases.csv beside this file, a row per case and method, and keeps the rows that are there already: delete a row to
have it computed anew; and from it the tables of hard_cases.md. What tubes, detectors and patients do to ideal X-rays is
in hard_scenes.py. Columns: inside_90, the share of voxels of more than -900 HU in truth inside the 90 % interval, and
interval_widening, where the method knows intervals; worst_view_misfit and worst_view, the view that
fits worst; error_rank_correlation, Spearman's, over voxels, of the deviation of eight samples with the true error of
their mean, where samples were drawn; body_rank_correlation, the same over voxels of more than -900 HU in truth;
difference_hu, root mean square difference from the volume that the case names; said: warnings, or the sentence with
which the case was refused.
"""

from __future__ import annotations

import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import nibabel
import numpy as np
import torch
from hard_scenes import blurred, drifted, focal_spot, heeled, lagging, scaled, water_cube, without_left_lung
from poses import USUAL, lowered, true_beam
from scipy.ndimage import rotate
from scipy.stats import spearmanr
from torch import Tensor
from torch.nn.functional import interpolate

from phydict import METHODS, ConeBeam, Grid, HUWindow, Projector, load_prior, reconstruct
from phydict.datasets import prepare_ct
from phydict.evaluation import body_weights, read_csv, volume_metrics, write_csv
from phydict.guard import worst_view
from phydict.posterior import Posterior
from phydict.prior import Prior
from phydict.prior.files import DEFAULT_PRIOR
from phydict.reconstruction import Reconstruction
from phydict.runtime.console import sentence
from phydict.units import mu_to_hu
from phydict.xray import Ideal
from phydict.xray.poses.uncertain import Uncertain

sys.path.append(str(Path(__file__).parents[1]))
from fitting import fit_to_grid

OUT = Path(__file__).with_suffix(".csv")
COLUMNS = ("case", "method", "ssim", "psnr", "mae_hu", "ssim_body", "psnr_body", "mae_hu_body", "misfit",
           "worst_view_misfit", "worst_view", "finite", "diverged_at", "error_rank_correlation",
           "body_rank_correlation", "difference_hu", "inside_90", "interval_widening", "said")
GRID, WINDOW, BEAM = Grid.cube(64), HUWindow(), ConeBeam.orbit(8, 1020, 740, (448, 448), 1.25)
FAR = ConeBeam.orbit(8, 1100, 740, (224, 224), 2.7)
"""With room for detectors that stand a little closer."""
FAST = METHODS["phydict_fast"]
SAMPLED = replace(FAST, sampling_noise=1.0)
CONTRADICTION = "Findings: There is a large right pneumothorax. Impression: Large right pneumothorax."
THREE = ("phydict_learned", "phydict_fast", "tv")
AGREEMENT = "Findings: The lungs are clear. Impression: No acute abnormality in the thorax."


@dataclass
class Case:
    """X-rays (K, V, U), where they were taken, the truth in HU, and the settings of `reconstruct`.

    run: another way to reconstruct; compared_with: a volume to compare the result with.
    """

    xrays: Tensor
    truth: Tensor
    beam: ConeBeam = BEAM
    settings: dict = field(default_factory=dict)
    run: Callable[[], Reconstruction] | None = None
    compared_with: Callable[[], Tensor] | None = None


class HardCases:
    """The cases of one CT by name, made when they are needed."""

    def __init__(self, ct: Path):
        self.ct, self.prior = ct, load_prior(DEFAULT_PRIOR)
        case = prepare_ct(ct, GRID)
        self.x, self.lung = case["volume"][None], case["masks"][0] > 0.5
        self.truth = WINDOW.to_hu(self.x)[0, 0]
        self.xrays = self.simulated()

    def simulated(self, mu: Tensor | None = None, beam: ConeBeam = BEAM, grid: Grid = GRID,
                  simulator: Ideal = Ideal()) -> Tensor:
        """Views (K, V, U) of mu (1, 1, X, Y, Z), the CT's own unless another is given."""
        mu = WINDOW.to_mu(self.x) if mu is None else mu
        return simulator(Projector(grid, beam, full_detector=True), mu, 0)[0]

    def cases(self) -> Iterator[tuple[str, str, Callable[[], Case]]]:
        """Name, method and maker of every case: those that lie in the data are faced by SIRT too."""
        for group in (self._orbits, self._bad_views, self._bad_data):
            yield from ((name, method, make) for name, make in group()
                        for method in ("phydict_fast", "sirt", "phydict_learned", "tv"))
        for group in (self._exposures, self._patients):
            yield from ((name, method, make) for name, make in group() for method in THREE)
        for group in (self._settings, self._precisions, self._seeds, self._samples, self._many_steps):
            yield from ((name, "phydict_fast", make) for name, make in group())

    def _with(self, method=FAST, **settings) -> Case:
        return Case(self.xrays, self.truth, settings={"method": method} | settings)

    def _orbit(self, views: int, degrees: float = 360.0) -> Case:
        beam = ConeBeam.orbit(views, 1020, 740, (448, 448), 1.25, arc=np.radians(degrees))
        return Case(self.simulated(beam=beam), self.truth, beam)

    def _orbits(self):
        yield "eight views", lambda: Case(self.xrays, self.truth)
        yield "one view", lambda: self._orbit(1)
        yield "two views", lambda: self._orbit(2)
        yield "arc of 60 degrees", lambda: self._orbit(8, 60)

    def _changed(self, change: Callable[[Tensor], Tensor], view: int = 3) -> Case:
        xrays = self.xrays.clone()
        xrays[view] = change(xrays[view])
        return Case(xrays, self.truth)

    def _bad_views(self):
        others = [0, 1, 2, 4, 5, 6, 7]
        yield "view 3 flipped", lambda: self._changed(lambda v: v.flip(-1))
        yield "view 3 upside down", lambda: self._changed(lambda v: v.flip(-2))
        yield "view 3 shifted by 5 pixels", lambda: self._changed(lambda v: v.roll(5, -1))
        yield "view 3 rotated by 2 degrees", lambda: self._changed(
            lambda v: torch.from_numpy(rotate(v.numpy(), 2, reshape=False, order=1)))
        yield "view 3 negated", lambda: self._changed(lambda v: v.max() - v)
        yield "view 3 missing, geometry of eight", lambda: Case(self.xrays[others], self.truth)
        yield "view 3 missing, geometry of seven", lambda: Case(self.xrays[others], self.truth, BEAM.select(others))
        yield "view 3 blank", lambda: self._changed(torch.zeros_like)
        yield "view 3 not a number", lambda: self._changed(lambda v: v * float("nan"))
        yield "view 2 in the place of view 3", lambda: self._changed(lambda v: self.xrays[2])
        twice = [*range(8), 3]
        yield "view 3 given twice, geometry too", lambda: Case(self.xrays[twice], self.truth, BEAM.select(twice))

    def _bad_data(self):
        def of(mu: Tensor, **more) -> Case:
            return Case(self.simulated(mu, **more), mu_to_hu(mu)[0, 0].clamp(WINDOW.low, WINDOW.high))

        mu = WINDOW.to_mu(self.x)
        for name, simulator in (("no noise", Ideal(0)), ("1e4 photons per pixel", Ideal(0, 1e4)),
                                ("100 photons per pixel", Ideal(0, 100)), ("10 % noise", Ideal(0.1))):
            yield name, lambda s=simulator: of(mu, simulator=s)
        yield "metal", lambda: of(self._metal(mu))
        narrow = ConeBeam.orbit(8, 1020, 740, (448, 200), 1.25)
        yield "truncated by a narrow detector", lambda: Case(self.simulated(beam=narrow), self.truth, narrow)
        yield "truncated: 1.4 times the patient", self._larger
        yield "line integrals 10 times too large", lambda: Case(10 * self.xrays, self.truth)
        yield "line integrals 10 times too small", lambda: Case(0.1 * self.xrays, self.truth)
        yield "decadic logarithms", lambda: Case(self.xrays / np.log(10), self.truth)
        yield "line integrals twice too large", lambda: Case(2 * self.xrays, self.truth)
        yield "display values taken for line integrals", lambda: Case(self._display(), self.truth)
        yield "display values", lambda: Case(self._display(), self.truth, settings={"display": True})
        yield "water of 0.025 / mm assumed", lambda: Case(self.xrays, self.truth, settings={"mu_water": 0.025})
        yield "CT stored as HU + 1024", lambda: self._stored(lambda hu: hu + 1024)
        yield "CT stored as HU / 10", lambda: self._stored(lambda hu: hu / 10)
        for name, value in (("all air", 0.0), ("all water", 0.02), ("all bone of 1000 HU", 0.04)):
            yield name, lambda v=value: of(torch.full_like(mu, v))

    @cached_property
    def first(self) -> Tensor:
        """The volume of seed 0."""
        return reconstruct(self.xrays, BEAM, self.prior, FAST).volume

    def _metal(self, mu: Tensor) -> Tensor:
        """A rod of 12 x 12 x 36 mm of 8000 HU beside the spine."""
        mu = mu.clone()
        mu[..., 31:33, 22:24, 30:36] = 0.18
        return mu

    def _exposures(self):
        """What tubes, detectors and a patient who moves do to the X-rays."""
        def of(xrays: Tensor, beam: ConeBeam = BEAM, **settings) -> Case:
            return Case(xrays, self.truth, beam, settings)

        def moved() -> Tensor:
            return self.simulated(beam=true_beam(FAR, "random", 0))

        def breathing() -> Tensor:
            xrays = self.simulated(beam=FAR)
            xrays[1::2] = self.simulated(WINDOW.to_mu(lowered(self.x[0])[None]), FAR)[1::2]
            return xrays

        yield "pose errors of 5 mm and 2 degrees", lambda: of(moved(), FAR)
        yield "pose errors, calibrated", lambda: of(moved(), FAR, uncertain=USUAL)
        yield "gain drift by 20 %", lambda: of(drifted(self.xrays))
        yield "gain drift, calibrated", lambda: of(drifted(self.xrays), uncertain=Uncertain(gain=0.1, offset=0.2))
        yield "heel effect of 30 %", lambda: of(heeled(self.xrays))
        yield "detector blur of 3 mm", lambda: of(blurred(self.xrays, 3 / 1.25))
        yield "detector lag of 5 %", lambda: of(lagging(self.xrays))
        yield "focal spot of 3 mm", lambda: of(-torch.stack([
            torch.exp(-self.simulated(beam=beam)) for beam in focal_spot(BEAM, 3)]).mean(0).log())
        yield "breathing by 10 mm", lambda: of(breathing(), FAR)
        yield "breathing by 10 mm, calibrated", lambda: of(breathing(), FAR, uncertain=USUAL)

    def _patients(self):
        """Patients unlike those of the training."""
        def of(x: Tensor) -> Case:
            return Case(self.simulated(WINDOW.to_mu(x)), WINDOW.to_hu(x)[0, 0])

        def stout() -> Case:
            """Of 55 cm, on voxels that hold 38 cm of them."""
            factor = 550 / width(self.truth)
            beam = ConeBeam.orbit(8, 1600, 1000, (448, 448), 2.2)
            x = interpolate(self.x, size=(64, 64, 64), mode="trilinear")
            xrays = self.simulated(WINDOW.to_mu(x), beam, Grid((64, 64, 64), (6 * factor, 6 * factor, 6.0)))
            return Case(xrays, WINDOW.to_hu(scaled(self.x, (factor, factor, 1.0)))[0, 0], beam)

        yield "child of 0.55 times the size", lambda: of(scaled(self.x, (0.55, 0.55, 0.55)))
        yield "patient of 55 cm", stout
        yield "cube of water of 20 cm", lambda: of(water_cube(self.x, in_range(0.0)))
        yield "patient upside down", lambda: of(self.x.flip(-1))
        yield "patient mirrored", lambda: of(self.x.flip(2))
        yield "left lung removed", lambda: of(without_left_lung(self.x, self.lung, in_range(20.0)))

    def _larger(self) -> Case:
        """A patient of whom the volume holds the middle alone, seen from further away."""
        beam = ConeBeam.orbit(8, 1600, 1000, (448, 448), 1.6)
        xrays = self.simulated(beam=beam, grid=Grid((64, 64, 64), (8.4, 8.4, 8.4)))
        middle = interpolate(self.x, scale_factor=1.4, mode="trilinear")
        first = (middle.shape[-1] - 64) // 2
        crop = slice(first, first + 64)
        return Case(xrays, WINDOW.to_hu(middle[0, 0, crop, crop, crop]), beam)

    def _display(self) -> Tensor:
        low, high = self.xrays.amin((1, 2), keepdim=True), self.xrays.amax((1, 2), keepdim=True)
        return (255 * (self.xrays - low) / (high - low)).round()

    def _stored(self, change: Callable[[np.ndarray], np.ndarray]) -> Case:
        image = nibabel.load(self.ct)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "stored.nii.gz"
            nibabel.save(nibabel.Nifti1Image(change(image.get_fdata(dtype=np.float32)), image.affine), file)
            wrong = prepare_ct(file, GRID)["volume"][None]
        return Case(self.simulated(WINDOW.to_mu(wrong)), self.truth)

    def _settings(self):
        for guidance in (1, 2, 3, 5, 7.5, 10):
            yield f"contradictory report, guidance {guidance:g}", lambda g=guidance: self._with(
                report=CONTRADICTION, guidance=g)
        for guidance in (1, 3, 10):
            yield f"report that agrees, guidance {guidance:g}", lambda g=guidance: self._with(
                report=AGREEMENT, guidance=g)
        for delta in (0.0, 0.01, 0.99):
            yield f"delta {delta:g}", lambda d=delta: self._with(replace(FAST, ec_delta=d, ec_steps=4))
        yield "1 noise level", lambda: self._with(replace(FAST, iterations=1, t_start=1.0, t_end=None))
        yield "2 noise levels", lambda: self._with(replace(FAST, iterations=2))

    def _many_steps(self):
        yield "1000 noise levels", lambda: self._with(replace(FAST, iterations=1000))

    def _precisions(self):
        def run(kind: torch.dtype, precision: str = "float32") -> Reconstruction:
            ready = Posterior(load_prior(DEFAULT_PRIOR).to(kind), FAST, precision=precision)
            xrays, projector = fit_to_grid(ready, GRID, self.xrays, BEAM)
            return ready.reconstruct(xrays.to(kind), projector)

        for name, kind, precision in (("bf16", torch.float32, "bfloat16"), ("fp32", torch.float32, "float32"),
                                      ("fp64", torch.float64, "float32")):
            yield f"denoiser in {name}, against fp64", lambda kind=kind, precision=precision: replace(
                self._with(), run=lambda: run(kind, precision), compared_with=lambda: run(torch.float64).volume)

    def _seeds(self):
        for seed in range(20):
            yield f"seed {seed}, against seed 0", lambda s=seed: replace(
                self._with(seed=s), compared_with=lambda: self.first)

    def _samples(self):
        known = dict(self._orbits()) | dict(self._bad_views()) | dict(self._bad_data())
        for name in ("eight views", "two views", "one view", "arc of 60 degrees", "view 3 flipped", "metal",
                     "truncated: 1.4 times the patient"):
            yield f"{name}, 8 samples", lambda make=known[name]: replace(
                make(), settings={"method": SAMPLED, "samples": 8})


def in_range(hu: float) -> float:
    return float(WINDOW.to_range(torch.tensor(hu)))


def width(hu: Tensor) -> float:
    """mm from side to side of what is denser than -300 HU in a quarter of its height or more."""
    seen = (hu > -300).any(1).float().mean(1) >= 0.25
    return GRID.spacing[0] * float(seen.sum())


def row(name: str, method: str, case: Case, prior: Prior) -> dict:
    """One case by one method; what it says and what it refuses is part of the result."""
    settings = {"method": FAST if method == "phydict_fast" else method} | case.settings
    own = None if method == "phydict_learned" else prior
    result: Reconstruction = case.run() if case.run else reconstruct(case.xrays, case.beam, own, **settings)
    truth = case.truth[None, None]
    scores = volume_metrics(result.volume[None, None], truth, body=body_weights(truth, GRID.spacing))
    worst, _ = worst_view(result.misfit_per_view)
    found = {"case": name, "method": method} | scores | {
        "misfit": result.misfit, "worst_view_misfit": result.misfit_per_view[worst], "worst_view": worst,
        "finite": bool(result.volume.isfinite().all()), "diverged_at": result.diverged_at or ""}
    if result.deviation is not None:
        error = (result.volume - case.truth).abs()
        for where, voxels in (("error", error >= 0), ("body", case.truth > -900)):
            found[f"{where}_rank_correlation"] = float(spearmanr(result.deviation[voxels], error[voxels]).statistic)
    if result.intervals:
        inside = (result.volume - case.truth).abs() <= result.intervals[0.9]
        found |= {"inside_90": float(inside[case.truth > -900].float().mean()),
                  "interval_widening": result.interval_widening}
    if case.compared_with:
        found["difference_hu"] = float((result.volume - case.compared_with()).square().mean().sqrt())
    return found


def attempt(name: str, method: str, make: Callable[[], Case], prior: Prior) -> dict:
    """The case's row with all columns, made under a watch for warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = row(name, method, make(), prior)
        except (ValueError, ArithmeticError) as error:
            found = {"case": name, "method": method, "said": f"refused: {sentence(error)}"}
    if caught:
        found["said"] = "; ".join(dict.fromkeys([*filter(None, [found.get("said")]),
                                                 *(" ".join(str(w.message).split()) for w in caught)]))
    return {column: found.get(column, "") for column in COLUMNS}


def table(rows: list[dict]) -> str:
    """Rows of phydict_fast as Markdown, its PSNR in the body and SIRT's PSNR beside its own; of what is said, the first
    clauses."""
    sirt = {row["case"]: row.get("psnr") for row in rows if row["method"] == "sirt"}
    scenes = {row["case"] for row in rows if row["method"] == "tv"} - sirt.keys()
    lines = ["| case | PSNR (dB) | PSNR body | SIRT's | MAE (HU) | misfit | worst view's | what is said |",
             "|---|---:|---:|---:|---:|---:|---:|---|"]
    for row in rows:
        if row["method"] == "phydict_fast" and row["case"] not in scenes and not row.keys() & {
                "difference_hu", "error_rank_correlation"}:
            figures = [(row.get("psnr"), 1), (row.get("psnr_body"), 1), (sirt.get(row["case"]), 1),
                       (row.get("mae_hu"), 0), (row.get("misfit"), 4), (row.get("worst_view_misfit"), 4)]
            told = ["-" if figure is None else f"{figure:.{digits}f}" for figure, digits in figures]
            lines.append(f"| {' | '.join([row['case'], *told, clauses(row)])} |")
    return "\n".join(lines) + "\n"


def scenes_table(rows: list[dict]) -> str:
    """Rows of THREE as Markdown: each method's PSNR, over all and in the body, what the first one's interval holds, and
    what each says."""
    lines = ["| case | PSNR (dB): learned | fast | tv | PSNR body: learned | fast | tv | inside 90 % | widened by | "
             "what learned says | fast and tv |", "|---|---:|---:|---:|---:|---:|---:|---:|---:|---|---|"]
    known = {(row["case"], row["method"]): row for row in rows}
    for name in dict.fromkeys(row["case"] for row in rows if row["method"] == THREE[0]):
        learned, fast, tv = (known.get((name, method), {}) for method in THREE)
        figures = [(row.get(of), 1) for of in ("psnr", "psnr_body") for row in (learned, fast, tv)] + [
            (100 * learned["inside_90"] if "inside_90" in learned else None, 0), (learned.get("interval_widening"), 1)]
        told = ["-" if figure is None else f"{figure:.{digits}f}" for figure, digits in figures]
        others = dict.fromkeys(said for row in (fast, tv) if (said := clauses(row)) != "-")
        lines.append(f"| {' | '.join([name, *told, clauses(learned), '; '.join(others) or '-'])} |")
    return "\n".join(lines) + "\n"


def clauses(row: dict) -> str:
    """The first clauses of what is said; views that were corrected are counted."""
    parts = [re.match("(refused: )?([^:,]|,(?= [0-9]))*", part).group() for part in row.get("said", "-").split("; ")
             if not re.search("^check |^state |^of display values | was corrected by | show the lower end ", part)]
    corrected = len(re.findall(" was corrected by ", row.get("said", "")))
    told = {f"views corrected by more than stated: {corrected}": corrected,
            "the patient breathed or moved between the views": " show the lower end " in row.get("said", "")}
    return "; ".join([*parts, *(words for words, true in told.items() if true)])


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("give a CT: python tests/benchmark/hard_cases.py <CT> [words in the names of cases]")
    hard, words = HardCases(Path(sys.argv[1])), sys.argv[2:]
    order = [(name, method) for name, method, _ in hard.cases()]
    rows = {(row["case"], row["method"]): row for row in read_csv(OUT)}
    for name, method, make in hard.cases():
        if (name, method) not in rows and (not words or any(word in name for word in words)):
            rows[name, method] = attempt(name, method, make, hard.prior)
            write_csv(OUT, [dict.fromkeys(COLUMNS) | rows[key] for key in sorted(rows, key=order.index)])
            print({column: value for column, value in rows[name, method].items() if value != ""}, flush=True)
    rows = read_csv(OUT)
    OUT.with_suffix(".md").write_text(f"{table(rows)}\n{scenes_table(rows)}")
