"""Samplers of the posterior, one file each."""
