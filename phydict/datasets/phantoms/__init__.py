"""Procedural thoraxes and their reports."""
