"""SSIM, PSNR and MAE of one case in Hounsfield units, and their statistics over cases.

Range: both volumes are clipped to `RANGE` = [-1000, 1000] HU unless the caller says otherwise, and the data range
is its width, 2000 HU. It is never inferred from the data. Every number here is per case; cases are averaged
afterwards and never pooled, because one bad case would dominate a pooled squared error.

    PSNR = 10 log10(R^2 / mean((x - y)^2))                                                    R = high - low
    SSIM = (2 m_x m_y + c1)(2 s_xy + c2) / ((m_x^2 + m_y^2 + c1)(s_x^2 + s_y^2 + c2))         c1 = (0.01 R)^2
                                                                                              c2 = (0.03 R)^2
    Wang et al. 2004, doi:10.1109/TIP.2003.819861, in 3-D, local moments m, s by a Gaussian of 11 taps

SSIM is taken on HU - low, which starts at 0 as the images it was made for do: on signed HU its luminance term would
divide by water's 0 and punish a tissue offset of 20 HU like a wrong structure. PSNR and MAE do not depend on the
offset. Its mean is over all voxels, volumes mirrored beyond their faces, as in torchmetrics; scikit-image leaves out
half a window at each face.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure
from torchmetrics.utilities.data import dim_zero_cat

from phydict.datasets import body_mask
from phydict.evaluation.bootstrap import bounds, estimate
from phydict.units import HUWindow

RANGE = HUWindow(-1000.0, 1000.0)
"""The HU range that volumes are clipped to before they are compared; its width is the data range R."""

TAPS, SIGMA = 11, 1.5
"""The SSIM window: taps and standard deviation in voxels along each axis."""


class Measure(NamedTuple):
    """How a metric is printed: label with its unit, whether higher is better (None: neither), decimals; target: the
    right value, where values on both sides of it are worse."""

    label: str
    higher_is_better: bool | None
    decimals: int
    target: float | None = None

    @property
    def heading(self) -> str:
        """The label with the direction in which the metric is better."""
        if self.target is not None:
            return f"{self.label} → {self.target:g}"
        return self.label + {True: " ↑", False: " ↓", None: ""}[self.higher_is_better]

    @property
    def ranks(self) -> bool:
        """Whether one value is better than another."""
        return self.higher_is_better is not None or self.target is not None

    def worth(self, value: float) -> float:
        """What is the higher, the better a value is."""
        if self.target is not None:
            return -abs(value - self.target)
        return value if self.higher_is_better else -value

    def unranked(self) -> Measure:
        """The same, of which no value is better than another."""
        return self._replace(higher_is_better=None, target=None)

    def off_target(self) -> Measure:
        """How far values are from the target; the measure itself without one."""
        if self.target is None:
            return self
        return self._replace(label=f"{self.label}, off {self.target:g}", higher_is_better=False, target=None)


MEASURES = {
    "ssim": Measure("SSIM", True, 3),
    "psnr": Measure("PSNR (dB)", True, 2),
    "mae_hu": Measure("MAE (HU)", False, 1),
    "ssim_body": Measure("SSIM body", True, 3),
    "psnr_body": Measure("PSNR body (dB)", True, 2),
    "mae_hu_body": Measure("MAE body (HU)", False, 1),
    "ssim_lung": Measure("SSIM lung", True, 3),
    "psnr_lung": Measure("PSNR lung (dB)", True, 2),
    "mae_hu_lung": Measure("MAE lung (HU)", False, 1),
    "psnr_slices": Measure("PSNR of slices (dB)", True, 2),
    "ssim_slices": Measure("SSIM of slices", True, 3),
    "ssim_uniform": Measure("SSIM 7^3", True, 3),
    "lpips_alex": Measure("LPIPS alex", False, 4),
    "lpips_squeeze": Measure("LPIPS squeeze", False, 4),
    "dice_lung": Measure("Dice lungs", True, 3),
    "dice_lung_ct": Measure("Dice lungs, of the CT itself", None, 3),
    "hd95_lung": Measure("HD95 lungs (mm)", False, 1),
    "cldice_vessel": Measure("clDice vessels", True, 3),
    "edge_diaphragm": Measure("diaphragm's width", None, 2, target=1.0),
    "edge_chest_wall": Measure("chest wall's width", None, 2, target=1.0),
    "ribs": Measure("ribs' contrast", None, 2, target=1.0),
    "vessels": Measure("vessels' contrast", None, 2, target=1.0),
    "clip_t2i": Measure("CLIP T2I (%)", True, 2),
    "clip_i2i": Measure("CLIP I2I (%)", True, 2),
    "misfit": Measure("misfit", False, 4),
    "seconds": Measure("time (s)", False, 2),
}
"""Every metric a table knows, in the order of its columns."""


def ssim_window(shape: Sequence[int]) -> tuple[list[int], list[float]]:
    """Taps and sigma per axis of the SSIM window for a volume of `shape` voxels.

    11 taps of sigma 1.5 where the side allows. On a side below 11 the window shrinks to the largest odd number
    of taps that fits, with sigma in proportion, because the window must fit into the volume; such scores are not
    comparable with those of larger volumes.
    """
    taps = [min(TAPS, n - 1 + n % 2) for n in shape]
    return taps, [SIGMA * n / TAPS for n in taps]


def body_weights(true_hu: Tensor, spacing: Sequence[float]) -> Tensor:
    """The body of a CT (1, 1, X, Y, Z) in HU at `spacing` mm, without couch and air, as `volume_metrics` takes it."""
    return torch.from_numpy(body_mask(true_hu[0, 0].float().cpu().numpy(), spacing))[None, None].float()


def volume_metrics(hu: Tensor, true_hu: Tensor, lung: Tensor | None = None, body: Tensor | None = None,
                   low: float = RANGE.low, high: float = RANGE.high) -> dict[str, float]:
    """SSIM, PSNR (dB) and MAE (HU) of ONE reconstructed case against the truth.

    hu, true_hu: (1, 1, X, Y, Z) in HU; both are clipped to [low, high] first, and R = high - low.
    lung, body: (1, 1, X, Y, Z) weights in [0, 1], or None. A mask adds the keys ssim_lung, psnr_lung and mae_hu_lung
        (_body): the mask-weighted means of the SSIM map, the squared and the absolute error. The SSIM map sees half a
        window (5 voxels) beyond the mask. A mask that is zero everywhere counts as None.
    Computed on the CPU in float32 and float64, since E[x^2] - E[x]^2 of HU loses its digits in TF32 and half precision;
    the scores are then the same on every machine. 64^3 takes about 0.3 s on one core.
    Identical volumes give SSIM 1, PSNR inf and MAE 0; a NaN in a volume makes its scores NaN.
    Raises ValueError on unequal shapes, more than one case, or an empty range.
    """
    window = HUWindow(low, high)
    if hu.shape != true_hu.shape or hu.ndim != 5 or hu.shape[:2] != (1, 1):
        raise ValueError(f"volume_metrics compares one case, two volumes of shape (1, 1, X, Y, Z), but "
                         f"{tuple(hu.shape)} and {tuple(true_hu.shape)} were given; loop over the batch")
    masks = {name: mask for name, mask in (("body", body), ("lung", lung)) if mask is not None}
    for name, mask in masks.items():
        if mask.shape != hu.shape:
            raise ValueError(f"the {name} mask needs the volume's shape {tuple(hu.shape)}, but {tuple(mask.shape)} was "
                             "given")
    limits = float(window.low), float(window.high)
    hu, true_hu = (volume.detach().cpu().float().clamp(*limits) for volume in (hu, true_hu))
    taps, sigma = ssim_window(hu.shape[2:])
    with torch.autocast("cpu", enabled=False):
        ssim, ssim_map = structural_similarity_index_measure(
            hu - low, true_hu - low, sigma=sigma, kernel_size=taps, data_range=high - low, return_full_image=True)
    hu, true_hu = hu.double(), true_hu.double()
    error = hu - true_hu
    result = {"ssim": ssim, "psnr": peak_signal_noise_ratio(hu, true_hu, data_range=limits),
              "mae_hu": error.abs().mean()}
    for name, mask in masks.items():
        if bool(mask.any()):
            weight = mask.detach().cpu().double()
            weight = weight / weight.sum()
            result |= {f"ssim_{name}": (weight * ssim_map).sum(),
                       f"psnr_{name}": 10 * torch.log10((2 * window.half_width) ** 2 / (weight * error**2).sum()),
                       f"mae_hu_{name}": (weight * error.abs()).sum()}
    return {name: float(value) for name, value in result.items()}


class Summary(NamedTuple):
    """Mean and sample standard deviation over `cases` (std NaN for one case), and the ends of the mean's 95 % interval
    by the bootstrap over patients (NaN for one); prints as mean ± std [low, high]."""

    mean: float
    std: float
    cases: frozenset[str]
    low: float = math.nan
    high: float = math.nan

    def __float__(self) -> float:
        return self.mean

    def __format__(self, spec: str) -> str:
        spread = "" if math.isnan(self.std) else f" ± {format(self.std, spec)}"
        return format(self.mean, spec) + spread + bounds(self.low, self.high, spec)


def case_values(rows: Iterable[Mapping], name: str) -> dict[str, float]:
    """{case: value} of a metric, rows of one case (several seeds) averaged, of cases of which each row has it; rows
    without the key "case" count as a case each. Raises ValueError where a value is text."""
    cases: dict[str, list] = {}
    for n, row in enumerate(rows):
        value = row.get(name)
        if isinstance(value, str):
            raise ValueError(f"{name} of {case_id(row, n)} by {row.get('method')} is {reprlib.repr(value)}, which is "
                             "no number as Python writes it, such as 20.5: correct or remove that row")
        cases.setdefault(case_id(row, n), []).append(value)
    return {case: float(np.mean(repeats)) for case, repeats in cases.items() if None not in repeats}


def case_id(row: Mapping, n: int) -> str:
    """The case of the n-th row of a method."""
    return str(row.get("case", f"row {n}"))


def over_cases(rows: Sequence[Mapping], metrics: Iterable[str]) -> dict[str, Summary]:
    """{metric: Summary} of those metrics that some row has, each case counting once (`case_values`)."""
    result = {}
    for name in metrics:
        if cases := case_values(rows, name):
            with np.errstate(invalid="ignore"):
                values = np.array(list(cases.values()))
                std = float(values.std(ddof=1)) if len(values) > 1 else math.nan
                mean, low, high = estimate(cases)
            result[name] = Summary(mean, std, frozenset(cases), low, high)
    return result


def summarise(rows: Iterable[Mapping]) -> dict[str, dict[str, Summary]]:
    """{method: {metric: Summary}} by `over_cases`, of every known metric that some row has, methods in order of
    appearance. Raises ValueError when there is no row, or a row lacks its method."""
    rows = list(rows)
    if not rows:
        raise ValueError("there are no rows to summarise; evaluate at least one case first")
    if lacking := next((row for row in rows if "method" not in row), None):
        raise ValueError(f"every row needs the column 'method' to be grouped by, but one has only {sorted(lacking)}")
    return {str(method): over_cases([row for row in rows if row["method"] == method], MEASURES)
            for method in dict.fromkeys(row["method"] for row in rows)}


class CaseMetrics(Metric):
    """Mean and standard deviation over cases of per-case values, for several methods; safe under DDP.

    methods: what `update` may be given, equal in every process.

    `compute` returns for each method and metric the mean over cases, "method/name", the sample standard deviation,
    "method/name_std" (NaN for a single case), and the number of cases, "method/cases". A metric that no case of a
    method has is left out. A NaN or an infinite value is kept, so that a failed case shows in the mean.
    A (case, method) pair seen again, as a distributed sampler repeats cases to fill the last batch, counts once.
    """

    full_state_update = False
    higher_is_better = None
    is_differentiable = False

    def __init__(self, methods: Sequence[str]):
        super().__init__()
        self.methods = tuple(methods)
        # Flat float64 rows [case, method, values, present]. torchmetrics gathers an empty process as a flat tensor of
        # the metric's dtype, so the state has to be both.
        self.set_dtype(torch.float64)
        self.values: list[Tensor]
        self.add_state("values", default=[], dist_reduce_fx="cat")

    def update(self, case: int, method: str, values: Mapping[str, float], seconds: float | None = None) -> None:
        """Add one case.

        case: its index in the dataset, the same in every process. values: metric name -> value, such as
        `volume_metrics` returns; a name left out or None counts as not measured. seconds: reconstruction time.
        Raises ValueError on a method that was not announced, and on an unknown name.
        """
        given = dict(values) if seconds is None else {**values, "seconds": seconds}
        if method not in self.methods:
            raise ValueError(f"method {method!r} is not one of {list(self.methods)}; "
                             "name it in CaseMetrics(methods=...)")
        if unknown := given.keys() - MEASURES.keys():
            raise ValueError(f"metrics {sorted(unknown)} are not among {list(MEASURES)}")
        row = [float(case), float(self.methods.index(method))]
        row += [math.nan if given.get(name) is None else float(given[name]) for name in MEASURES]
        row += [float(given.get(name) is not None) for name in MEASURES]
        self.values.append(torch.tensor(row, dtype=torch.float64, device=self.device))

    def compute(self) -> dict[str, Tensor]:
        """Statistics over cases as a flat dict of scalars, ready for a logger."""
        cases, result = self._cases(), {}
        for method in self.methods:
            rows = [values for (_, name), values in cases.items() if name == method]
            if rows:
                result[f"{method}/cases"] = torch.tensor(float(len(rows)))
            for name, summary in over_cases(rows, MEASURES).items():
                result[f"{method}/{name}"] = torch.tensor(summary.mean, dtype=torch.float64)
                result[f"{method}/{name}_std"] = torch.tensor(summary.std, dtype=torch.float64)
        return result

    def _cases(self) -> dict[tuple[int, str], dict[str, float]]:
        n = len(MEASURES)
        table = dim_zero_cat(self.values).reshape(-1, 2 + 2 * n).tolist() if len(self.values) else []
        cases: dict[tuple[int, str], dict[str, float]] = {}
        for case, method, *row in sorted(table, key=lambda row: row[:2]):
            values = {name: value for name, value, present in zip(MEASURES, row[:n], row[n:]) if present}
            cases.setdefault((int(case), self.methods[int(method)]), values)
        return cases
