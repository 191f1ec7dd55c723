"""MedSyn's networks and files."""
