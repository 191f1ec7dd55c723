"""Methods and settings compared on the same X-rays: from a YAML file to one table, further tables and plots."""

from phydict.ablation.command import main
from phydict.ablation.spec import Specification, read_specification
from phydict.ablation.trials import Trial

__all__ = ["Specification", "Trial", "main", "read_specification"]
