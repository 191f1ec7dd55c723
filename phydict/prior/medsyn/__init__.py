"""MedSyn's two networks and their files, as priors."""
