"""The command line that makes the page of results anew."""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from phydict.ablation.page import is_comparison, page_anew
from phydict.inference.page import results_page
from phydict.runtime.console import cli_errors, quiet


def main(args: Sequence[str]) -> None:
    """infer.py page <folder>. A bad input ends in one sentence and exit code 2."""
    with cli_errors(), quiet():
        parser = ArgumentParser(prog=f"{Path(sys.argv[0]).name} page", exit_on_error=False, allow_abbrev=False,
                                description="Write index.html, which shows the results of predict, test or ablate in a "
                                            "browser, from what they left on disk.")
        parser.add_argument("folder", type=Path, help="model.out, a method's folder in it, or the out of ablate")
        given = parser.parse_args(args)
        if not given.folder.is_dir():
            raise ValueError(f"{given.folder} is no folder: give the one that predict, test or ablate wrote to")
        page = page_anew(given.folder) if is_comparison(given.folder) else results_page(given.folder)
        print(f"page: {page}")
