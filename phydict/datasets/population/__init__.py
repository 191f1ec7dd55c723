"""New anatomies out of few patients: registration, combinations of shapes, organs of other sizes, findings."""

from phydict.datasets.population.anatomy import Anatomy, Variation
from phydict.datasets.population.drawn import DrawnPatients, PopulationSettings
from phydict.datasets.population.population import Population

__all__ = ["Anatomy", "DrawnPatients", "Population", "PopulationSettings", "Variation"]
