"""Reconstruction with Lightning."""
