"""What the refiner sees of the X-rays: residual, coverage, changes of the estimate and the noise."""

import pytest
import torch
from scenes import block

from phydict.posterior.evidence import CHANGE_SCALE, COVERAGE_SCALE, RESIDUAL_SCALE, Evidence
from phydict.xray import ConeBeam
from posterior.hollow import GRID, ORBIT, measured


def test_exact_x_rays_of_the_estimate_leave_no_residual_and_the_back_projection_lowers_one():
    m = measured(dtype=torch.float64)
    evidence, truth = Evidence(m), block().double()
    assert evidence(truth, truth, truth)[:, 0].abs().max() < 1e-9 * RESIDUAL_SCALE
    z = truth + 0.1 * (truth > -0.5)
    step = evidence(z, truth, truth)[:, :1] / RESIDUAL_SCALE
    before, after = ((m.project(x) - m.y).norm() for x in (z, z + step))
    assert after < 0.5 * before


def test_the_coverage_counts_the_views_that_see_a_voxel():
    narrow = ConeBeam.orbit(4, 1020, 740, (28, 6), 20.0)
    for beam in (ORBIT, narrow):
        coverage = 2 ** (Evidence(measured(beam)).coverage / COVERAGE_SCALE) - 1
        assert float(coverage[0, 0, 6:10, 6:10, 6:10].mean()) == pytest.approx(beam.views, rel=0.1)
    assert coverage[0, 0, 0, 0, 8] < 1  # a corner that the narrow detector misses


def test_the_evidence_tells_changes_of_the_estimate_and_the_noise():
    evidence, zeros = Evidence(measured(noise=0.01)), torch.zeros(1, 1, *GRID.shape)
    channels = evidence(zeros + 0.3, zeros + 0.1, zeros)
    torch.testing.assert_close(channels[:, 2:4], CHANGE_SCALE * torch.stack([zeros[:, 0] + 0.2, zeros[:, 0] - 0.3], 1))
    assert 10 ** (float(channels[0, 4].mean()) - 2) == pytest.approx(0.01, rel=0.3)
