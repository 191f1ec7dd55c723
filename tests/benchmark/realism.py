"""How far phantoms are from real chest CTs on the prior's grid, beside how far the CTs are from one another.

    python tests/benchmark/realism.py <folder of CTs> [number of phantoms, 24 if left out]

Writes realism.csv beside this file, a row per figure, and prints it. The phantoms have held-out seeds and are built
without their findings, since no report belongs to the CTs.

    a number of each case    its mean and standard deviation over CTs and phantoms; distance: the difference of the
                             means over the CTs' standard deviation
    a histogram or profile   mean distance of a case from all CTs but itself, of CTs and of phantoms; distance: their
                             ratio. Histograms: first Wasserstein distance in HU. Profiles over the height of the lungs
                             (eight slabs from the bases to the apices, one beyond either end): root mean square
                             difference from the CTs' mean over their standard deviation
    classifier               area under the ROC curve of a logistic regression that tells phantoms from CTs by slices
                             or by blocks of 48 mm of the body, each patient judged by a fit that has not seen them;
                             beside it, CTs told from CTs, the patients split at random; below it, the features with the
                             largest standardised weights, positive where phantoms have more
"""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from scipy.stats import rankdata, wasserstein_distance

from phydict.datasets import Thorax, build, find_cts, prepare_ct, without
from phydict.datasets.cts.anatomy import body_mask
from phydict.datasets.phantoms.cached import HELD_OUT_PHANTOM
from phydict.evaluation import write_csv
from phydict.grid import Grid
from phydict.units import HUWindow

GRID, WINDOW = Grid.cube(64), HUWindow()
MM, ML = 6.0, 0.216
CLASSES = {"gas and lung": (-1001, -500), "fat": (-150, -30), "soft tissue": (-30, 180),
           "bone or contrast": (180, 2000)}
BANDS = (2, 8, 16, 32, 50, 83)
"""Edges in cycles per metre."""
SLABS = np.arange(-1, 9)
BLOCK = 8


def span(mask: np.ndarray, axis: int) -> float:
    """Extent in mm of a mask along an axis."""
    others = tuple(a for a in range(mask.ndim) if a != axis)
    filled = np.nonzero(mask.any(others))[0]
    return MM * (filled[-1] - filled[0] + 1) if len(filled) else 0.0


def grain(hu: np.ndarray, where: np.ndarray) -> float:
    """Median HU by which voxels differ from the mean of their two neighbours to the left and right."""
    second = np.abs(hu[1:-1] - (hu[2:] + hu[:-2]) / 2)
    inside = where[1:-1] & where[2:] & where[:-2]
    return float(np.median(second[inside])) if inside.any() else 0.0


class Case:
    """One chest: HU and lung, airway and vessel masks on the grid, and the figures taken of it."""

    def __init__(self, name: str, hu: np.ndarray, masks: np.ndarray):
        self.name, self.hu, self.masks = name, hu.clip(WINDOW.low, WINDOW.high), masks
        self.body = body_mask(self.hu, GRID.spacing)
        self.lung = masks[0] > 0.5
        levels = np.nonzero(self.lung.sum((0, 1)) > 3)[0]
        self.low, self.high = levels[0], levels[-1] + 1
        self.middle = (self.low + self.high) // 2

    def slab(self, number: int) -> slice:
        """The slices of an eighth of the lungs' height; -1 and 8 lie below and above the lungs."""
        ends = np.rint(self.low + (self.high - self.low) * np.array([number, number + 1]) / 8).astype(int)
        return slice(*ends.clip(0, self.hu.shape[2]))

    def values(self) -> dict[str, np.ndarray]:
        """HU whose histograms are compared."""
        inside = self.hu[self.body]
        eroded = ndimage.binary_erosion(self.lung)
        return ({"all voxels": self.hu.ravel(), "body": inside, "lung off its border": self.hu[eroded],
                 "between body and edge of the box": self.hu[~self.body]}
                | {name: inside[(inside > low) & (inside <= high)] for name, (low, high) in CLASSES.items()})

    def profiles(self) -> dict[str, np.ndarray]:
        """Figures over the height of the lungs (10,); NaN where nothing was scanned."""
        rows = []
        for number in SLABS:
            part = self.slab(number)
            hu, body, lung = self.hu[..., part], self.body[..., part], self.lung[..., part]
            count = body.shape[2]
            if not body.any():
                rows.append([np.nan] * 10)
                continue
            inside = hu[body]
            column = np.abs(np.arange(64) - 31.5) * MM < 20
            filled = np.nonzero(body.any((0, 2)))[0]
            behind = np.arange(64) < filled.mean()
            bone = (hu > 180) & column[:, None, None] & behind[:, None] & body
            centre = (np.nonzero(bone)[1].mean() - 31.5) * MM if bone.any() else np.nan
            back, front = (filled[[0, -1]] - 31.5) * MM
            rows.append([body.sum() / count * MM**2 / 100, lung.sum() / count * MM**2 / 100, span(body, 0),
                         span(body, 1), inside.mean(), (inside > 180).sum() / count * MM**2 / 100,
                         ((inside > -150) & (inside < -30)).mean(), centre, back, front])
        names = ("body area", "lung area", "body width", "body depth", "mean HU of the body", "bone area", "fat share",
                 "spine's position", "back's position", "front's position")
        return dict(zip(names, np.array(rows).T))

    def numbers(self) -> dict[str, float]:
        """Single figures of the case."""
        inside, lung = self.hu[self.body], self.lung
        seen = (self.hu > WINDOW.low + 0.5).any((0, 1))
        bottom = np.where(lung.any(2), lung.argmax(2), -1)
        bottom = bottom[bottom >= 0] * MM
        section = self.body[..., self.middle]
        chest = lung[..., self.low + (self.high - self.low) // 3]
        between = [np.ptp(np.nonzero(row)[0]) + 1 - row.sum() for row in chest.T if row[:32].any() and row[32:].any()]
        soft = ndimage.binary_erosion(self.body & (self.hu > 0) & (self.hu < 110))
        outside = ~ndimage.binary_dilation(self.body, iterations=2)
        outside[..., ~seen] = False
        result = {"lung L": self.masks[0].sum() * ML / 1000, "right share of the lungs":
                  self.masks[0][32:].sum() / self.masks[0].sum(), "lung width mm": span(lung, 0),
                  "lung depth mm": span(lung, 1), "lung height mm": span(lung, 2),
                  "height of the diaphragm over its recess mm": np.quantile(bottom, 0.9) - np.quantile(bottom, 0.02),
                  "mediastinum's width at a third of the lungs mm": MM * np.median(between) if between else np.nan,
                  "airway mL": self.masks[1].sum() * ML, "vessel share of the lungs":
                  self.masks[2].sum() / self.masks[0].sum(), "median HU of the lungs": np.median(self.hu[lung]),
                  "body's cross-section cm2": section.sum() * MM**2 / 100, "body's depth over width":
                  span(section, 1) / span(section, 0), "bone above 180 HU mL per 100 mm":
                  (inside > 180).sum() * ML / max(self.body.any((0, 1)).sum() * MM / 100, 0.01),
                  "share above 400 HU %": 100 * (inside > 400).mean(), "grain in lung HU": grain(self.hu, lung),
                  "grain in soft tissue HU": grain(self.hu, soft), "grain in fat HU":
                  grain(self.hu, self.body & (self.hu < -60) & (self.hu > -150)),
                  "scanned height mm": seen.sum() * MM,
                  "table and clothes, share outside the body above -950 HU %": 100 * (self.hu[outside] > -950).mean(),
                  "nothing reconstructed, share outside the body %": 100 * (self.hu[outside] < -999.9).mean(),
                  "slices above the lungs mm": (np.nonzero(seen)[0][-1] + 1 - self.high) * MM,
                  "slices below the lungs mm": (self.low - np.nonzero(seen)[0][0]) * MM}
        result |= {f"{name}, share of the body %": 100 * ((inside > low) & (inside <= high)).mean()
                   for name, (low, high) in CLASSES.items()}
        return {key: float(value) for key, value in (result | self.spectrum()).items()}

    def spectrum(self) -> dict[str, float]:
        """Power in dB (of HU^2) of the Hann-windowed volume in bands of spatial frequency, along z and across."""
        window = np.hanning(66)[1:-1]
        power = np.abs(np.fft.fftn((self.hu - self.hu.mean()) * np.einsum("i,j,k->ijk", *[window] * 3))) ** 2
        power /= self.hu.size * (window**2).mean() ** 3
        frequency = np.stack(np.meshgrid(*[np.fft.fftfreq(64, MM / 1000)] * 3, indexing="ij"))
        radius = np.sqrt((frequency**2).sum(0))
        along = np.abs(frequency[2]) > 0.7 * np.maximum(radius, 1e-9)
        result = {}
        for low, high in itertools.pairwise(BANDS):
            shell = (radius >= low) & (radius < high)
            for name, part in (("across", shell & ~along), ("along z", shell & along)):
                result[f"power {low}-{high} per m {name} dB"] = 10 * np.log10(power[part].mean())
        return result

    def slices(self) -> tuple[list[str], np.ndarray]:
        """Features of every second axial slice through the lungs."""
        rows = []
        for k in range(self.low, self.high, 2):
            hu, body = self.hu[..., k], self.body[..., k]
            if body.sum() > 100:
                rows.append(_features(hu[None], body[None]) | {"area": body.sum(), "width": span(body, 0),
                            "depth": span(body, 1), "lung": self.lung[..., k].sum(), "outside": hu[~body].mean()})
        return list(rows[0]), np.array([list(row.values()) for row in rows])

    def blocks(self) -> tuple[list[str], np.ndarray]:
        """Features of the blocks that the body fills for the most part."""
        rows = []
        for corner in np.ndindex(*[64 // BLOCK] * 3):
            cut = tuple(slice(BLOCK * c, BLOCK * c + BLOCK) for c in corner)
            if self.body[cut].mean() > 0.7:
                rows.append(_features(self.hu[cut], self.body[cut]))
        return list(rows[0]), np.array([list(row.values()) for row in rows])


def _features(hu: np.ndarray, body: np.ndarray) -> dict[str, float]:
    """What a piece of CT looks like: HU levels and how they change from voxel to voxel."""
    inside = hu[body]
    edges = (-1001, -950, -900, -850, -750, -500, -200, -120, -80, -30, 0, 30, 60, 100, 180, 300, 500, 2000)
    counts = np.histogram(inside, edges)[0] / len(inside)
    result = {f"share {low}..{high}": np.sqrt(share) for low, high, share in zip(edges[:-1], edges[1:], counts)}
    for name, axis in (("x", -2), ("y", -1)):
        step = np.abs(np.diff(hu, axis=axis))[body[:, 1:] if axis == -2 else body[..., 1:]]
        result |= {f"step {name} {q}": np.log(1 + np.quantile(step, q / 100)) for q in (25, 50, 75, 95)}
    return result


def roc_area(scores: np.ndarray, labels: np.ndarray) -> float:
    """Area under the ROC curve, by ranks."""
    ones = labels > 0.5
    return float((rankdata(scores)[ones].mean() - (ones.sum() + 1) / 2) / (~ones).sum())


def logistic(features: np.ndarray, labels: np.ndarray, penalty: float = 0.01) -> np.ndarray:
    """Weights and offset (F + 1,) of a logistic regression in which both classes count the same."""
    x = torch.from_numpy(np.c_[features, np.ones(len(features))])
    y = torch.from_numpy(labels)
    share = torch.where(y > 0.5, 0.5 / y.sum(), 0.5 / (1 - y).sum())
    weights = torch.zeros(x.shape[1], dtype=x.dtype, requires_grad=True)
    fit = torch.optim.LBFGS([weights], max_iter=100, line_search_fn="strong_wolfe")

    def loss():
        fit.zero_grad()
        miss = torch.nn.functional.binary_cross_entropy_with_logits(x @ weights, y, weight=share, reduction="sum")
        total = miss + penalty * weights[:-1].square().sum()
        total.backward()
        return total

    fit.step(loss)
    return weights.detach().numpy()


def told_apart(groups: list[np.ndarray], labels: np.ndarray, folds: int = 8) -> tuple[float, np.ndarray]:
    """Area under the ROC curve over pieces, judged by fits without their patient; the weights of a fit of all."""
    owner = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    x, y = np.concatenate(groups), labels[owner].astype(float)
    x = (x - x.mean(0)) / (x.std(0) + 1e-6)
    fold, scores = np.empty(len(groups), int), np.empty(len(x))
    for value in (0, 1):
        fold[labels == value] = np.arange((labels == value).sum()) % folds
    for number in range(folds):
        out = fold[owner] == number
        weights = logistic(x[~out], y[~out])
        scores[out] = x[out] @ weights[:-1] + weights[-1]
    return roc_area(scores, y), logistic(x, y)[:-1]


def classifier_rows(cts: list[Case], phantoms: list[Case]) -> list[dict]:
    """The classifier's figures and the features it latches on to."""
    rows = []
    for kind in ("slices", "blocks"):
        pieces = {id(case): getattr(case, kind)() for case in cts + phantoms}
        names = pieces[id(cts[0])][0]
        groups = [pieces[id(case)][1] for case in cts + phantoms]
        area, weights = told_apart(groups, np.repeat([0, 1], [len(cts), len(phantoms)]))
        splits = [np.random.default_rng(i).permutation(len(cts)) % 2 for i in range(4)]
        control = np.mean([told_apart(groups[:len(cts)], split, max(len(cts) // 2, 2))[0] for split in splits])
        rows.append({"kind": "classifier", "figure": f"ROC area of {kind}", "real": control, "phantom": area,
                     "distance": (area - 0.5) / 0.5})
        for i in np.argsort(-np.abs(weights))[:6]:
            rows.append({"kind": "classifier", "figure": f"{kind}: {names[i]}", "distance": weights[i]})
    return rows


def number_rows(cts: list[Case], phantoms: list[Case]) -> list[dict]:
    """Means, spreads and standardised distances of single figures."""
    real, made = ([case.numbers() for case in cases] for cases in (cts, phantoms))
    rows = []
    for figure in real[0]:
        a, b = (np.array([numbers[figure] for numbers in side]) for side in (real, made))
        rows.append({"kind": "number", "figure": figure, "real": np.nanmean(a), "real_sd": np.nanstd(a, ddof=1),
                     "phantom": np.nanmean(b), "phantom_sd": np.nanstd(b, ddof=1),
                     "distance": (np.nanmean(b) - np.nanmean(a)) / max(np.nanstd(a, ddof=1), 1e-9)})
    return rows


def histogram_rows(cts: list[Case], phantoms: list[Case]) -> list[dict]:
    """Wasserstein distances of HU histograms from all CTs but the case itself."""
    real, made = ([case.values() for case in cases] for cases in (cts, phantoms))
    bins = np.linspace(WINDOW.low, WINDOW.high, 401)
    middle = (bins[1:] + bins[:-1]) / 2
    rows = []
    for figure in real[0]:
        a, b = (np.array([np.histogram(values[figure], bins)[0] / len(values[figure]) for values in side])
                for side in (real, made))

        def away(histogram, others):
            return wasserstein_distance(middle, middle, histogram, others.mean(0))

        rows.append(_distance_row("histogram", f"{figure} HU", a, b, away))
    return rows


def profile_rows(cts: list[Case], phantoms: list[Case]) -> list[dict]:
    """Distances of profiles over the lungs' height from all CTs but the case itself."""
    real, made = ([case.profiles() for case in cases] for cases in (cts, phantoms))
    rows = []
    for figure in real[0]:
        a, b = (np.array([profiles[figure] for profiles in side]) for side in (real, made))

        def away(profile, others):
            spread = np.fmax(np.nanstd(others, 0, ddof=1), 0.1 * np.nanmax(np.nanstd(others, 0, ddof=1)))
            return np.sqrt(np.nanmean(((profile - np.nanmean(others, 0)) / spread) ** 2))

        rows.append(_distance_row("profile", figure, a, b, away))
    return rows


def _distance_row(kind: str, figure: str, real: np.ndarray, made: np.ndarray, away: Callable) -> dict:
    """How far each curve is from those of all CTs but one: a CT from those of the others."""
    own, other = ([away(one, np.delete(real, i % len(real), 0)) for i, one in enumerate(side)] for side in (real, made))
    return {"kind": kind, "figure": figure, "real": np.mean(own), "real_sd": np.std(own, ddof=1),
            "phantom": np.mean(other), "phantom_sd": np.std(other, ddof=1), "distance": np.mean(other) / np.mean(own)}


def compare(cts: list[Case], phantoms: list[Case]) -> list[dict]:
    """All figures of phantoms beside those of CTs."""
    parts = (histogram_rows, profile_rows, number_rows, classifier_rows)
    columns = ("kind", "figure", "real", "real_sd", "phantom", "phantom_sd", "distance")
    return [{column: row.get(column, "") for column in columns} for part in parts for row in part(cts, phantoms)]


def phantom(seed: int) -> Case:
    """The healthy twin of one seed."""
    hu, masks = build(without(Thorax.draw(seed)), GRID)
    return Case(f"phantom-{seed}", hu, masks)


def ct(file) -> Case:
    """A CT on the grid, centred on its lungs."""
    case = prepare_ct(file.path, GRID, WINDOW, id=file.id)
    return Case(file.id, WINDOW.to_hu(case["volume"][0].numpy()), case["masks"].numpy())


def table(rows: list[dict]) -> str:
    """The rows in Markdown, three significant digits."""
    lines = ["| figure | CTs | their spread | phantoms | their spread | distance |", "|---|---|---|---|---|---|"]
    for row in rows:
        cells = [row[key] if row[key] == "" else f"{row[key]:.3g}" for key in list(row)[2:]]
        lines.append(f"| {row['kind']}: {row['figure']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 24
    rows = compare([ct(file) for file in find_cts(sys.argv[1])],
                   [phantom(HELD_OUT_PHANTOM + i) for i in range(count)])
    write_csv(Path(__file__).with_suffix(".csv"), rows)
    print(table(rows))
