"""How the evidence of X-rays is laid out for networks (phydict.posterior.evidence computes it)."""

EVIDENCE_CHANNELS = 5
"""Residual, coverage, change by the X-rays, difference from the start, noise."""

RESIDUAL_SCALE, CHANGE_SCALE, COVERAGE_SCALE = 10.0, 2.0, 0.2
"""Factors that bring the channels to a size near 1."""
