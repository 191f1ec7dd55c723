"""A population of a user's CTs as a dataset: registered once, each draw made once, all of it in the cache."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch.utils.data import Dataset

from phydict.datasets.case import Case
from phydict.datasets.cts.cache import TRAINING_PARTS, kept_case, key_of, read_arrays, write_arrays
from phydict.datasets.cts.ct_rate import CTCases, as_one_patient, patient_of
from phydict.datasets.population.anatomy import Variation, findings_of
from phydict.datasets.population.population import Population
from phydict.datasets.population.registration import Registered, features, medoid, register
from phydict.datasets.prose import write_report
from phydict.runtime.progress import CaseProgress
from phydict.runtime.progress_log import log_progress
from phydict.runtime.ranges import check_fields
from phydict.runtime.warning import warn

POPULATION_VERSION = 3
"""Raised whenever a registration or a draw of the same seed comes out differently; older files are not read then."""

MOST_DRAWS = 10_000_000


@dataclass(frozen=True)
class PopulationSettings:
    """New patients drawn from the CTs, to train on beside these.

    Args:
        share: share of the CT draws that are taken from the population, in [0, 1]
        draws: number of different new patients
        patients: most patients that are registered, 6 to 10 s each; of more, so many are picked
        variation: how far new patients go from those that are there
    """

    share: float = 0.0
    draws: int = 1000
    patients: int = 50
    variation: Variation = Variation()

    def __post_init__(self):
        check_fields(self, "data.loading.population", share=(0, 1), draws=(1, MOST_DRAWS), patients=(2, MOST_DRAWS))


class DrawnPatients(Dataset):
    """New patients of consecutive seeds, each drawn at its first use and stored as a file in the CTs' cache.

    cts: the CTs, one scan of each patient is registered when first needed. Those that cannot be are named in a warning
    and left out. Raises ValueError where fewer than two CTs are given, or could be registered.
    """

    def __init__(self, cts: CTCases, settings: PopulationSettings = PopulationSettings()):
        self.settings, self.count = settings, settings.draws
        firsts = {patient_of(ct.id): i for i, ct in reversed(list(enumerate(cts.cts)))}
        picked = sorted(firsts.values())
        if len(picked) > settings.patients:
            picked = sorted(np.random.default_rng(0).permutation(picked)[:settings.patients].tolist())
        if len(picked) < 2:
            raise ValueError(f"a population is drawn from the CTs of at least 2 patients, but there "
                             f"{'is 1' if picked else 'are 0'} to train on"
                             + (f" ({cts.cts[picked[0]].id})" if picked else "")
                             + as_one_patient(ct.id for ct in cts.cts)
                             + ": give more CTs, or set data.loading.population.share to 0")
        if len(firsts) < len(cts.cts):
            log_progress(f"the population is of one scan of each of {len(firsts)} patients, of {len(cts.cts)} CTs; "
                         "those in one subfolder count as one patient's", event="population", patients=len(firsts),
                         cts=len(cts.cts))
        self.cts = CTCases([cts.cts[i] for i in picked], cts.cache, cts.grid, cts.window)
        self.folder = cts.cache and cts.cache / f"population{POPULATION_VERSION}"
        self.population: Population | None = None

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, seed: int) -> Case:
        population = self.prepare()
        file = self.drawn and self.drawn / f"{seed:07d}.npz"
        case = kept_case(file, lambda: population.case(population.draw(seed, self.settings.variation), seed),
                         TRAINING_PARTS)
        return case | {"id": f"population-{seed:06d}"}

    def reports(self, most: int) -> list[str]:
        """Reports such as draws have, for learning their words; nothing is registered for them."""
        drawn = [(seed, findings_of(seed, self.settings.variation.findings)) for seed in range(min(most, self.count))]
        return [write_report(findings, seed % 2 == 0, seed) for seed, findings in drawn if findings]

    def prepare(self) -> Population:
        """Registers the CTs, or reads how they were; for use before several processes draw."""
        if self.population is not None:
            return self.population
        cases = [self.cts[i] for i in range(len(self.cts))]
        faults = {i: "no lungs were found in it" for i, case in enumerate(cases) if not case["has_masks"][0]}
        usable = [i for i in range(len(cases)) if i not in faults]
        images = {i: features(cases[i], self.cts.grid, self.cts.window) for i in usable}
        template = usable[medoid(list(images.values()))] if usable else -1
        registered = self._registered(images, template)
        faults |= {i: one.fault for i, one in registered.items() if one.fault}
        for i, fault in sorted(faults.items()):
            warn(f"the CT {cases[i]['id']} does not register ({fault}): it is left out of the population")
        left = [i for i in registered if i not in faults]
        if len(left) < 2:
            raise ValueError(f"a population is drawn from at least 2 CTs, but {len(left)} of {len(cases)} could be "
                             "registered: give other CTs, or set data.loading.population.share to 0")
        self.drawn = self.folder and self.folder / key_of([
            [[self.cts.key(self.cts.cts[i]), cases[i]["report"]] for i in left], left.index(template),
            asdict(self.settings.variation)])
        self.overlaps = [registered[i].overlap for i in left if i != template]
        self.population = Population([cases[i] for i in left], torch.stack([registered[i].velocity for i in left]),
                                     left.index(template), self.cts.grid, self.cts.window)
        return self.population

    def _registered(self, images: dict[int, torch.Tensor], template: int) -> dict[int, Registered]:
        keys = {i: self.cts.key(self.cts.cts[i]) for i in images}
        files = {i: self.folder and self.folder / f"{self.cts.cts[i].id}-{key_of([keys[i], keys[template]])}.npz"
                 for i in images}
        stored = {i: read_arrays(file) if file else None for i, file in files.items()}
        registered = {i: Registered(torch.from_numpy(one["velocity"]), float(one["overlap"]), float(one["least"]))
                 for i, one in stored.items() if one is not None}
        left = [i for i in images if i not in registered]
        with CaseProgress() as progress:
            if left:
                progress.begin("CTs", len(left), verb="register")
            for i in left:
                progress.case(self.cts.cts[i].id)
                image = images[i]
                registered[i] = register(images[template], image) if i != template else Registered.template(image)
                if file := files[i]:
                    write_arrays(file, {name: np.asarray(value) for name, value in vars(registered[i]).items()})
                progress.finished(f"lungs overlap by {registered[i].overlap:.2f}")
        return dict(sorted(registered.items()))
