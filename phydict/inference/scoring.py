"""What a test or a comparison measures of every case, beside misfit and time."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from phydict.datasets.case import Case
from phydict.datasets.cts.segmentations import organs_beside
from phydict.evaluation import RANGE, body_weights, volume_metrics
from phydict.evaluation.backbones import MAISI_SIDE, NORMALISATION, SliceFeatures, maisi_voxels
from phydict.evaluation.ct_clip import clip_scores, image_latent, load_ct_clip
from phydict.evaluation.fid import case_features
from phydict.evaluation.organs import ORGANS_VERSION, fine_grid, organ_scores
from phydict.evaluation.perceptual import check_sides, load_networks, lpips_scores
from phydict.evaluation.published import PUBLISHED
from phydict.evaluation.sharpness import sharpness_scores
from phydict.grid import Grid
from phydict.inference.protocols import Protocol
from phydict.inference.voxels import resampled
from phydict.reconstruction import Reconstruction
from phydict.runtime.files import file_crc32
from phydict.units import HUWindow

METRICS = ("volume", "lpips", "fid", "organs", "sharpness", "clip")


@dataclass(frozen=True)
class FIDSettings:
    """The Frechet distance of slices.

    Args:
        backbone: squeezenet, radimagenet or inception; each has a scale of its own
        weights: the file of its weights; squeezenet takes LPIPS' own
        replicates: draws of patients for the 95 % intervals; 0: no intervals
        maisi_voxels: whether volumes are put on MAISI's 512 x 512 x 512 voxels of 1 mm first, for figures beside its
            own; 512 times the pixels of 64 x 64 x 64 voxels
    """

    backbone: str = "squeezenet"
    weights: str | None = None
    replicates: int = 200
    maisi_voxels: bool = False

    def __post_init__(self):
        if self.replicates < 0:
            raise ValueError(f"fid.replicates is a number of draws, 0 for no intervals, but "
                             f"{self.replicates} was given")

    @property
    def normalisation(self) -> str:
        """Of the slices, in words."""
        return f"{MAISI_SIDE}^3 voxels of 1 mm. {NORMALISATION}" if self.maisi_voxels else NORMALISATION


@dataclass(frozen=True)
class CLIPSettings:
    """CT-CLIP's scores.

    Args:
        weights: its checkpoint, CT-CLIP_v2.pt; none given: the scores stay empty
        text: a folder with CXR-BERT's config.json, weights and vocabulary, or its hub id; none given: no score of
            reports
    """

    weights: str | None = None
    text: str | None = None

    def __post_init__(self):
        if self.text and not self.weights:
            raise ValueError(f"clip.text {self.text} means nothing without CT-CLIP's checkpoint: give clip.weights")


class Scoring:
    """The metrics of a run, with the networks that they need.

    metrics: names among METRICS; volume (SSIM, PSNR, MAE) is always measured. Raises ValueError for an unknown name,
    and ValueError or FileNotFoundError, in one sentence, where a metric's weights are missing.
    """

    def __init__(self, metrics: Sequence[str] = ("volume",), fid: FIDSettings = FIDSettings(),
                 clip: CLIPSettings = CLIPSettings()):
        if isinstance(metrics, str) or (unknown := [name for name in metrics if name not in METRICS]):
            raise ValueError(f"metrics is a list of some of {', '.join(METRICS)}, but "
                             f"{metrics if isinstance(metrics, str) else unknown[0]} was given")
        self.metrics, self.fid = tuple(name for name in METRICS if name in metrics), fid
        for name, given, default in (("fid", fid, FIDSettings()), ("clip", clip, CLIPSettings())):
            if given != default and name not in self.metrics:
                raise ValueError(f"settings of {name} mean nothing without that metric: add {name} to the metrics")
        self.network = SliceFeatures(fid.backbone, fid.weights) if "fid" in self.metrics else None
        self.clip = load_ct_clip(clip.weights, clip.text) if clip.weights else None
        networks = {"lpips": load_networks() if "lpips" in self.metrics else None,
                    "fid": None if fid.weights else self.network}  # of these torch.hub finds the files
        self.checksums = {f"{name}_weights_crc32": file_crc32(Path(file)) for name, file in (
            ("fid", fid.weights), ("clip", clip.weights)) if file} | {
                f"{name}_weights_crc32": weights_crc32(network)
                for name, network in networks.items() if network is not None}

    def settings(self) -> dict:
        """What decides the scores beyond those that are always taken; empty where there is nothing."""
        further = [name for name in self.metrics if name != "volume"]
        return ({"metrics": further} if further else {}) | (
            {"fid_backbone": self.fid.backbone} if self.network else {}) | (
            {"fid_maisi_voxels": True} if self.network and self.fid.maisi_voxels else {}) | (
            {"organs_version": ORGANS_VERSION} if "organs" in self.metrics else {}) | (
            {"clip_text": self.clip.text_transformer is not None} if self.clip else {}) | self.checksums

    def check(self, grid: Grid) -> None:
        """Raises ValueError where volumes on `grid` are too small for a metric."""
        if "lpips" in self.metrics:
            check_sides(grid.shape)
        if self.network and not self.fid.maisi_voxels:
            self.network.check(grid.shape)

    @property
    def empty(self) -> dict[str, str]:
        """Scores that may stay empty -> why they then do."""
        if "clip" not in self.metrics:
            return {}
        if self.clip is None:
            return dict.fromkeys(("clip_t2i", "clip_i2i"), "CT-CLIP's checkpoint was not given (clip.weights)")
        return {"clip_t2i": "CXR-BERT was not given (clip.text)" if self.clip.text_transformer is None else
                "no case has a report"}

    def prepare(self, case: Case, grid: Grid) -> None:
        """Reads what the metrics need beside a case's CT, of a case that is scored on `grid`, so that what does not fit
        is refused before it is reconstructed. Raises ValueError as `organs_beside`."""
        if "organs" in self.metrics:
            case["segmented"] = segmented(case, grid)

    def measured(self, result: Reconstruction, case: Case, grid: Grid, window: HUWindow, device: torch.device,
                 protocol: Protocol | None) -> tuple[dict[str, float], dict[str, Tensor] | None]:
        """The `scores` of a result, on whatever voxels, of a CT case on `grid`, and its `features`."""
        volume = resampled(result.volume, result.grid, grid)
        return (self.scores(volume, result.misfit, case, grid, window, device, protocol),
                self.features(volume, case, grid, window, device))

    def scores(self, volume: Tensor, misfit: float, case: Case, grid: Grid, window: HUWindow,
               device: torch.device, protocol: Protocol | None = None) -> dict[str, float]:
        """Metric -> value of a reconstructed volume (X, Y, Z) in HU on `grid`, of a CT case as `case_scores` takes it;
        in the HU range of a protocol, and with its own scores."""
        scored = protocol.window if protocol else RANGE
        scores = case_scores(volume, misfit, case, grid, window, scored)
        truth = window.to_hu(case["volume"])[0].cpu()
        if protocol:
            scores |= {name: PUBLISHED[name](volume, truth, scored) for name in protocol.scores}
        if "lpips" in self.metrics:
            scores |= lpips_scores(volume, truth, device, scored)
        if "organs" in self.metrics:
            scores |= organ_scores(volume, truth, grid, case["segmented"])
        if "sharpness" in self.metrics and bool(case["has_masks"][0]):
            scores |= sharpness_scores(volume, truth, case["masks"][0].cpu(), grid)
        if self.clip:
            model = self.clip.to(device)
            if "clip_latent" not in case:
                case["clip_latent"] = image_latent(model, truth, grid)
            scores |= clip_scores(model, volume, case["clip_latent"], grid, case.get("ct_report", case["report"]))
        return scores

    def features(self, volume: Tensor, case: Case, grid: Grid, window: HUWindow,
                 device: torch.device) -> dict[str, Tensor] | None:
        """The features of the slices of a volume on `grid` and of the truth, where FID is measured; the case keeps the
        truth's."""
        if self.network is None:
            return None

        def shown(hu: Tensor) -> Tensor:
            return maisi_voxels(hu.to(device), grid) if self.fid.maisi_voxels else hu.to(device)

        truth = case.get("features") or shown(window.to_hu(case["volume"])[0])
        case["features"] = case_features(self.network.to(device), shown(volume), truth)
        return case["features"]


def weights_crc32(network: nn.Module) -> int:
    """A checksum of a network's weights, by their names, wherever their files came from."""
    crc = 0
    for name, weight in network.state_dict().items():
        crc = zlib.crc32(weight.detach().cpu().contiguous().numpy(), zlib.crc32(name.encode(), crc))
    return crc


def case_scores(volume: Tensor, misfit: float, case: Case, grid: Grid, window: HUWindow,
                scored: HUWindow = RANGE) -> dict[str, float]:
    """Scores of a reconstructed volume (X, Y, Z) in HU on `grid` against the CT case that its X-rays were made of, in
    the HU range `scored`: over the whole volume, in the body, which leaves out couch and air (`body_weights` of the
    CT), and in the lungs if known."""
    truth = window.to_hu(case["volume"])[None].cpu()
    lung = case["masks"][None, :1].cpu() if bool(case["has_masks"][0]) else None
    body = body_weights(truth, grid.spacing)
    if lung is not None:  # a lung that the field of view cuts open is not filled in the body
        body = torch.maximum(body, (lung > 0.5).float())
    return volume_metrics(volume[None, None], truth, lung, body, scored.low, scored.high) | {"misfit": misfit}


def segmented(case: Case, grid: Grid) -> dict:
    """Organs that are segmented beside a case's CT, on the finer voxels on which organs are compared; often none."""
    file: Path | None = case.get("file")
    if file is None or "affine" not in case:
        return {}
    fine = fine_grid(Grid(grid.shape, affine=case["affine"].numpy()))
    return organs_beside(file, fine, case.get("calibration"))
