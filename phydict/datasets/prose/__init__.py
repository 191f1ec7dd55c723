"""Chest reports in prose: how radiologists word findings, their absence, and everything else."""

from phydict.datasets.prose import phrases
from phydict.datasets.prose.report import write_report
from phydict.datasets.prose.sentences import Pen, unrelated
from phydict.datasets.prose.words import naming_words, telling_words, written_words

__all__ = ["Pen", "naming_words", "phrases", "telling_words", "unrelated", "write_report", "written_words"]
