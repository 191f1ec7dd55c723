"""The command line that makes the page of results anew."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from phydict.ablation.page import is_comparison, page_anew
from phydict.inference.page import results_page
from phydict.runtime.console import check_writable, cli_errors, quiet
from phydict.runtime.progress_log import progress_options, run_command


def write_page(folder: Path) -> None:
    """Write index.html, which shows the results of predict, test or ablate in a browser, from what they left on disk.

    Args:
        folder: model.out, a method's folder in it, or the out of ablate
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder: give the one that predict, test or ablate wrote to")
    check_writable(folder, "folder, such as a copy")
    print(f"page: {page_anew(folder) if is_comparison(folder) else results_page(folder)}")


def main(args: Sequence[str]) -> None:
    """infer.py page <folder>. A bad input ends in one sentence and exit code 2."""
    with progress_options(args), cli_errors(), quiet():
        run_command(write_page, args, f"{Path(sys.argv[0]).name} page", positional=True)
