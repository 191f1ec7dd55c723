"""Reports are learnt before denoising: findings told, and what they change sketched on the right side."""

from statistics import mean

import pytest
import torch

from phydict.grid import Grid
from phydict.prior import Prior, TextEncoder, VolumeUNet, learn_vocabulary
from phydict.training.reports import learn_findings, learn_sketch
from phydict.units import HUWindow

SIDES = ("right", "left")
WORDS = ("A large pleural effusion on the {}.", "There is a {} pleural effusion.",
         "Consolidation in the {} lower lobe.", "No pneumothorax. Focal consolidation in the {} upper lobe.")
REPORTS = [words.format(side) for words in WORDS for side in SIDES]
LABELS = torch.tensor([[float(side == "left"), float("effusion" in words)] for words in WORDS for side in SIDES])


def untaught(seed: int = 0) -> Prior:
    torch.manual_seed(seed)
    text = TextEncoder.small(learn_vocabulary(REPORTS), 32, 2, 32)
    return Prior(VolumeUNet(4, 2, (16, 16), (False, True), 1, 8, 32), Grid.cube(16), HUWindow(), text)


@pytest.fixture(scope="module")
def prior():
    return untaught()


def test_findings_are_told(prior):
    losses = learn_findings(prior.text, REPORTS, LABELS, steps=80)
    assert mean(losses[-10:]) < 0.1 * mean(losses[:3])


def test_a_report_changes_the_sketch_on_the_side_it_names(prior):
    cells = prior.network.text_map.cells
    coarse = torch.zeros(len(REPORTS), 1, cells, cells, cells)
    coarse[0::2, :, cells // 2:] = 1.0  # right: high i
    coarse[1::2, :, :cells // 2] = 1.0
    learn_findings(prior.text, REPORTS, LABELS, steps=80)
    learn_sketch(prior, REPORTS, coarse, steps=80)
    right, left = (prior.network.text_map.sketch(prior.context([WORDS[0].format(side)]))[0, 0] for side in SIDES)
    assert (right - left)[cells // 2:].mean() > 0.5 and (left - right)[:cells // 2].mean() > 0.5


def test_learning_replays_from_its_seed():
    def run():
        return learn_findings(untaught(1).text, REPORTS, LABELS, steps=3)

    assert run() == run()
