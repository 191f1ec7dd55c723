"""Views whose poses are not exactly known: their unknowns, and what each of them changes in a projection."""
