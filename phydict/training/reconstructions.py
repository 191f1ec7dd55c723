"""Lightning data for training a refinement: crops of reconstructions that are each made once."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d
from torch.utils.data import ConcatDataset, Dataset

from phydict.datasets import Augmentation, CTSource
from phydict.datasets.case import Case
from phydict.datasets.cts.augment import augment
from phydict.datasets.cts.cache import key_of
from phydict.datasets.phantoms.cached import VALIDATION_PHANTOM
from phydict.datasets.surroundings.surroundings import Surroundings
from phydict.grid import Cube, Grid
from phydict.posterior import Posterior, Refined, Refinement, Unrolled
from phydict.posterior.refined import network_input
from phydict.prior import DEFAULT_CORRECTION, DEFAULT_REFINER, Refiner, fingerprint, load_correction, load_prior
from phydict.prior.correction import INPUTS, CorrectionNetwork
from phydict.prior.files import held_out_of
from phydict.prior.finer_uncertainty import INPUT_CHANNELS
from phydict.reconstruction import describe
from phydict.runtime.progress_log import log_progress
from phydict.runtime.ranges import check_fields
from phydict.runtime.seeds import check_seed
from phydict.training.crops import CTVolumes, PhantomVolumes
from phydict.training.data import PriorData, check_plain
from phydict.training.draws import Draws, Items, random_cube
from phydict.training.made import MadeOnce
from phydict.training.scenes import Scenes
from phydict.training.settings import HoldOut, Loading
from phydict.units import AIR, HUWindow
from phydict.xray import Projector
from phydict.xray.boxes import binned_to, interpolated, refinements

FINER = 2
"""How many times finer the voxels that X-rays are made of are than those of a reconstruction."""

SPARSE = 4
"""Of how many voxels along each axis one tells the error of a whole reconstruction."""

STRENGTH = Augmentation(girth=0, contrast=0, surroundings=Surroundings.none())
"""How patients are changed: by what needs no masks."""


@dataclass(frozen=True)
class RefinementCases:
    """The reconstructions that a refinement learns from.

    Args:
        reconstructions: how many are made to learn from; with more CTs, of CTs that are chosen at random
        validation: how many of each held-out volume
        crop: voxels along each side of what is learnt from at once
        network: the file of a network of this kind; the reconstructions are then also shown as they are at the second
            call, after its correction at the first
        seed: of the scenes that are learnt from, for a further run to learn from others
        source: which CTs of data.cts' folder are taken, as data.source of other stages
    """

    reconstructions: int = 60
    validation: int = 2
    crop: int = 64
    network: str | None = None
    seed: int = 0
    source: CTSource = CTSource()

    def __post_init__(self):
        check_seed(self.seed)
        check_fields(self, "data.made", reconstructions=(1, 1_000_000), validation=(1, 1000), crop=(8, 4096))


class _Recording:
    """Keeps what a network sees at each call on a `grid`'s voxels; without one nothing is corrected."""

    def __init__(self, network: CorrectionNetwork | None, grid: Grid):
        self.network, self.grid, self.inputs = network, grid, list[Tensor]()

    def suits(self, grid: Grid, window: HUWindow) -> bool:
        return self.grid.same_as(grid) or (self.network is not None and self.network.suits(grid, window))

    def corrected(self, z: Tensor, evidence: Tensor, precision: str) -> Tensor:
        if z.shape[2:] == self.grid.shape:
            self.inputs.append(torch.cat([z, evidence], 1))
        return self.network.corrected(z, evidence, precision) if self.network else z

    def half_widths(self, grid: Grid, seen: Tensor, precision: str) -> None:
        return None


class Reconstructions(MadeOnce):
    """What a refinement sees, at each call of `network`, and last the truth: (calls INPUTS + 1, X, Y, Z) in half
    precision, in the prior's range.

    name: of its folders. channels: of what is seen at a call. default_network: the file that stands for None.
    of_intervals: whether the refiner needs to know them.

    Item n shows volume n modulo their number, deformed unless `strength` is that of none, in a scene of its own.
    """

    name, channels, default_network, of_intervals = "reconstructions", INPUTS, cast(str | None, None), False

    def __init__(self, volumes: Items, grid: Grid, base: str, network: str | None, scenes: Scenes,
                 strength: Augmentation, folder: Path, length: int, seed: int):
        super().__init__(folder, length)
        self.volumes, self.grid, self.base, self.network = volumes, grid, base, network
        self.scenes, self.strength, self.seed = scenes, strength, seed

    @torch.no_grad()
    def _made(self, n: int) -> Tensor:
        rng, refiner = np.random.default_rng((self.seed, n)), cast(Refiner, load_prior(self.base))
        volume, window = np.array(self.volumes[n % len(self.volumes)], np.float32), refiner.window
        scene = Grid(volume.shape, tuple(self.grid.extent / volume.shape))
        case: Case = {"volume": torch.from_numpy(volume)[None], "masks": torch.zeros(0, *volume.shape), "report": "",
                      "id": str(n)}
        ct = augment(case, int(rng.integers(2**31)), scene, window, self.strength)["volume"][None]
        y, projector = self.scenes.xrays(ct, rng, scene, window)
        seen = self._seen(Posterior(refiner, Unrolled()), *binned_to(self.grid, y, projector.beam, False))
        return torch.cat([seen, avg_pool3d(ct, FINER)], 1)[0]

    def _seen(self, base: Posterior, xrays: Tensor, projector: Projector) -> Tensor:
        """What is seen (1, calls INPUTS, X, Y, Z) of a reconstruction by `base`."""
        record = _Recording(load_correction(self.network) if self.network else None, self.grid)
        refinement = Refinement(calls=2 if self.network else 1, mirrored=False)
        Refined(base, self.grid, refinement, (record,)).reconstruct(xrays, projector)
        return torch.cat(record.inputs, 1)


class RefinedResults(Reconstructions):
    """What a FinerUncertainty sees of the results of `network`, and last the truth: (INPUT_CHANNELS + 1, X, Y, Z)."""

    name, channels, default_network, of_intervals = "results", INPUT_CHANNELS, str(DEFAULT_CORRECTION), True

    def _seen(self, base: Posterior, xrays: Tensor, projector: Projector) -> Tensor:
        network = load_correction(cast(str, self.network))
        found = Refined(base, self.grid, Refinement(), (network,)).reconstruct(xrays, projector)
        assert found.coarse is not None
        start = interpolated(found.coarse.within, found.coarse.grid, self.grid, AIR)
        x, start = (base.window.to_range(hu)[None, None] for hu in (found.within, start))
        return network_input(x, start, found.coarse, base.window, self.grid)


class ReconstructionCrops(Draws):
    """Random cubes of reconstructions at one of their calls, half of them mirrored left to right: what is seen of so
    little has no side.

    channels: of what is seen at a call. "scale" (2,) are the mean squared and the mean absolute error of the
    reconstruction that a cube is cut from.
    """

    def __init__(self, made: Reconstructions, size: int, length: int, epoch: int, seed: int):
        super().__init__(made, [], 1.0, length, epoch, seed)
        self.size, self.channels = size, made.channels

    def item(self, drawn: np.ndarray, rng: np.random.Generator) -> dict:
        first = self.channels * int(rng.integers(len(drawn) // self.channels))
        cut = drawn[(slice(None), *random_cube(drawn[-1], self.size, rng))]
        crop = torch.from_numpy(cut[[*range(first, first + self.channels), -1]].astype(np.float32))
        estimate, truth = (torch.from_numpy(drawn[i, ::SPARSE, ::SPARSE, ::SPARSE].astype(np.float32))
                           for i in (first, -1))
        error = estimate - truth
        return {"volume": crop.flip(1) if rng.random() < 0.5 else crop,
                "scale": torch.stack([error.square().mean(), error.abs().mean()])}


class Whole(Dataset):
    """Reconstructions as they are at the last call."""

    def __init__(self, made: Reconstructions):
        self.made = made

    def __len__(self) -> int:
        return len(self.made)

    def __getitem__(self, n: int) -> dict:
        return {"volume": torch.from_numpy(self.made[n][-self.made.channels - 1:].astype(np.float32))}


class RefinementData(PriorData):
    """Crops of reconstructions for training a refinement.

    Args:
        made: the reconstructions
        scenes: the X-rays of which they are made
        cts: a NIfTI file, or a folder of any depth in CT-RATE's layout or any other
        holdout: what validates instead of training
        phantoms: number of different phantoms
        loading: how crops are drawn
        cache: folder for volumes and reconstructions, never inside the CTs' folder
        initial: the refiner's file
        cube: tied to model.cube
        window: tied to model.window
    """

    kind: type[Reconstructions] = Reconstructions

    def __init__(self, made: RefinementCases = RefinementCases(), scenes: Scenes = Scenes(most_views=16),
                 cts: str | None = None, holdout: HoldOut = HoldOut(phantoms=0), phantoms: int = 0,
                 loading: Loading = Loading(), cache: str = "runs/cache", initial: str = str(DEFAULT_REFINER),
                 cube: Cube = Cube(128), window: tuple[float, float] = (-1000.0, 1000.0)):
        if loading.population.share:
            raise ValueError(f"a refinement learns from reconstructions of CTs and phantoms alone, but "
                             f"data.loading.population.share is {loading.population.share}: set it to 0")
        check_plain(loading)
        if loading.ct_fraction != Loading.ct_fraction:
            raise ValueError("reconstructions are made of CTs and phantoms in turn, but data.loading.ct_fraction is "
                             f"{loading.ct_fraction}: leave it out")
        super().__init__(cts, made.source, holdout, phantoms, loading, cache, cube=cube, window=window)
        if self.factor != 1:
            raise ValueError(f"X-rays of reconstructions are made of {FINER * cube.voxels} voxels anyway, but "
                             f"data.loading.simulation_voxels is {loading.simulation_voxels}: leave it out")
        refiner = load_prior(initial)
        if not isinstance(refiner, Refiner) or refiner.window != self.window:
            raise ValueError(f"reconstructions are made by a refiner in the HU window {window}, but {initial} is none: "
                             "give a refiner's file as data.initial, and model.window as its own")
        if self.kind.of_intervals and refiner.uncertainty is None:
            raise ValueError(f"intervals on finer voxels are made of a refiner's own, but {initial} has none: "
                             "train them first, with configs/prior/uncertainty.yaml")
        self.check_unseen(held_out_of(initial), f"the training of {initial}")
        if not refinements(refiner.grid, self.grid):
            raise ValueError(f"reconstructions are refined to voxels finer than the refiner's, but model.cube has "
                             f"{cube.voxels} as it has: give more")
        if not made.crop <= cube.voxels:
            raise ValueError(f"data.made.crop is at most the {cube.voxels} voxels of a reconstruction, but {made.crop} "
                             "was given")
        shown, name = self.cts.cts, f"trained-{made.seed}"
        if made.reconstructions < len(shown):
            chosen = np.random.default_rng(made.seed).permutation(len(shown))[:made.reconstructions]
            shown, name = [shown[i] for i in chosen], f"{name}-chosen"
        scene, folder = Grid.cube(FINER * cube.voxels, cube.side), Path(cache)
        volumes: list[ConcatDataset] = [
            ConcatDataset([CTVolumes(cts, folder, scene, self.window),
                           PhantomVolumes(first, count, scene, self.window, folder)])
            for cts, first, count in ((shown, 0, phantoms),
                                      (self.held_out_cts.cts, VALIDATION_PHANTOM, holdout.phantoms))]
        trained, validated = volumes
        network = made.network or self.kind.default_network
        validating = holdout.phantoms and [VALIDATION_PHANTOM, holdout.phantoms]
        self.made_by = {"data.initial": fingerprint(initial),
                        "data.made.network": fingerprint(network) if network else None}
        parts = [asdict(scenes), describe(Unrolled()), describe(Refinement()), asdict(STRENGTH),
                 *self.made_by.values(), scene.to_dict(), self.origin(), validating,
                 [[ct.id, self.held_out_cts.key(ct)] for ct in self.held_out_cts.cts]]
        folder = folder / f"{self.kind.name}-{key_of(parts)}"
        self.crop, self.made = made.crop, self.kind(
            trained, self.grid, initial, network, scenes, STRENGTH, folder / name,
            made.reconstructions, made.seed)
        self.validation = Whole(self.kind(
            validated, self.grid, initial, network, scenes, Augmentation.none(), folder / "validated",
            made.validation * len(validated), 1))
        self.held_out_cts = CTVolumes(self.held_out_cts.cts, Path(cache), scene, self.window)

    def prepare_data(self) -> None:
        super().prepare_data()
        shown, cts = len(self.made), len(self.cts)
        if self.trainer.state.fn == "fit" and shown < cts:
            log_progress(f"{shown} of {cts} CTs are learnt from, chosen at random; data.made.reconstructions {cts} "
                         "would take them all", event="shown", cts=cts, shown=shown)

    def draws(self, epoch: int) -> Dataset:
        if not self.trainer or self.trainer.is_global_zero:
            self.made.log_made()
        return ReconstructionCrops(self.made, self.crop, self.loading.epoch_size, epoch, self.seed)

    def collate(self, cases: list[dict]) -> dict:
        return torch.utils.data.default_collate(cases)


class RefinedResultsData(RefinementData):
    """Crops of results for training a FinerUncertainty; settings as RefinementData's, with the network of
    `made.network`, the shipped one if left out, and a refiner with intervals."""

    kind = RefinedResults
