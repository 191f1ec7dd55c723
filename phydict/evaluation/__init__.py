"""How good a reconstruction is: volume metrics, result tables and picture panels."""

from phydict.evaluation.csv_file import read_csv, write_csv
from phydict.evaluation.gallery import method_panel, panel
from phydict.evaluation.metrics import RANGE, CaseMetrics, body_weights, summarise, volume_metrics
from phydict.evaluation.tables import Table, mean_table

__all__ = ["RANGE", "CaseMetrics", "Table", "body_weights", "mean_table", "method_panel", "panel", "read_csv",
           "summarise", "volume_metrics", "write_csv"]
