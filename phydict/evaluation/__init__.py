"""How good a reconstruction is: volume metrics, result tables and picture panels."""

from phydict.evaluation.gallery import method_panel, panel
from phydict.evaluation.metrics import RANGE, CaseMetrics, volume_metrics
from phydict.evaluation.tables import markdown, read_csv, rich_table, summarise, write_csv

__all__ = ["RANGE", "CaseMetrics", "markdown", "method_panel", "panel", "read_csv",
           "rich_table", "summarise", "volume_metrics", "write_csv"]
