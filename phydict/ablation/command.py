"""The command line of ablations: runs what is missing of a specification, then makes its tables and plots."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import get_type_hints

import torch
from jsonargparse import ArgumentParser

from phydict.ablation.fid import distance_tables, write_distances
from phydict.ablation.page import comparison_page
from phydict.ablation.plots import write_plots
from phydict.ablation.results import Results
from phydict.ablation.run import planned, run
from phydict.ablation.spec import read_specification
from phydict.ablation.summary import summarise
from phydict.ablation.tables import all_tables, write_tables
from phydict.datasets import CTSource
from phydict.inference.results import RESULTS
from phydict.inference.scoring import METRICS, Scoring
from phydict.methods import METHODS
from phydict.page import check_own_page
from phydict.runtime.configurations import check_configured
from phydict.runtime.console import check_apart, check_writable, cli_errors, ended_by_sigterm, quiet
from phydict.runtime.device import usable_device
from phydict.runtime.files import alone_in
from phydict.runtime.help import HelpFormatter, show_settings
from phydict.runtime.parser_message import naming_unknown_options
from phydict.runtime.progress import CaseProgress
from phydict.runtime.progress_log import add_progress_options, progress_options


def main(args: list[str] | None = None) -> None:
    """infer.py ablate -c <file>. A bad input ends in one sentence and exit code 2; a stopped run resumes."""
    args = sys.argv[1:] if args is None else args
    with progress_options(args), cli_errors(), quiet():
        check_configured(args, (), "configs/ablate/pareto.yaml")
        parser = _parser(args)
        with naming_unknown_options(parser):
            given = parser.parse_args(args).as_dict()
        device = usable_device(given.pop("device") or ("cuda" if torch.cuda.is_available() else "cpu"), "--device")
        del given["quiet"], given["json_lines"]
        keep_volumes = given.pop("keep_volumes")
        source = {name: value for name, value in given.pop("source").items() if value is not None}
        given["source"] = source or None
        file, *more = given.pop("config")
        if more:
            raise ValueError(f"one file says what to compare, but {' and '.join([file, *more])} were given: give one, "
                             "and change its settings by --set")
        specification = read_specification(file, given.pop("set"), **given)
        check_writable(specification.out, "out")
        check_own_page(specification.out, "out")
        check_apart(specification.out, "out", [Path(cts)] if (cts := specification.cases.cts) else [])
        scoring = Scoring(specification.metrics, specification.fid, specification.clip)
        results = None
        try:
            with ended_by_sigterm(), alone_in(specification.out, "out"):
                with CaseProgress() as progress:
                    results, cases = planned(specification, scoring)
                    run(results, cases, device, progress, scoring, keep_volumes)
                _write_summary(specification.out, results, scoring)
        except (KeyboardInterrupt, SystemExit):
            if results:
                _page_so_far(specification.out, results.all_rows, scoring)
            raise


def _write_summary(out: Path, results: Results, scoring: Scoring) -> None:
    """Writes what is made of a finished table: distances, tables, plots and page. Raises ValueError where no row is
    ok."""
    entries = summarise(results.rows)
    write_distances(out, entries, scoring)
    tables = all_tables(entries, scoring.empty) + distance_tables(out, entries)
    plots = write_plots(out, entries)
    written = write_tables(out, tables) + plots
    page = comparison_page(out, entries, tables, plots)
    print(f"{len(results.rows)} rows in {out / RESULTS}")  # all is written before: its reader may have read enough
    print(f"tables and plots in {out}: {', '.join(path.name for path in written)}")
    print(f"page: {page}")
    if not any(row["status"] == "ok" for row in results.rows):
        raise ValueError(f"none of the rows in {out / RESULTS} is ok; the first: {entries[0].error}")


def _page_so_far(out: Path, rows: Sequence[dict], scoring: Scoring) -> None:
    """Writes the page of the rows of a stopped run, where any came out well, without the Frechet distances of slices,
    which take long."""
    entries = summarise(rows)
    with suppress(ValueError, OSError):  # what stopped the run is the error to show
        if any(entry.counted for entry in entries):
            print(f"page: {comparison_page(out, entries, all_tables(entries, scoring.empty))}")


def _parser(args: Sequence[str]) -> ArgumentParser:
    """The options, and in their help the settings of each method that `args` name."""
    parser = ArgumentParser(
        prog=f"{Path(sys.argv[0]).name} ablate", exit_on_error=False, allow_abbrev=False,
        formatter_class=HelpFormatter,
        description="Compare methods on the same X-rays: every combination of settings that a file names, one row of "
                    "results each, then tables and plots. `ablate --set method=NAME --help` shows the settings of a "
                    f"method, one of {', '.join(METHODS)}.")
    parser.add_argument("-c", "--config", required=True, action="append",
                        help="what to compare: a YAML file, or the name of a shipped one, such as pareto")
    parser.add_argument("--cts", type=str, help="a NIfTI file or a folder of CTs, instead of the file's cases")
    parser.add_argument("--phantoms", type=int, help="a number of phantoms, instead of the file's cases")
    parser.add_argument("--only", type=str, help="a text file of the case ids to take")
    parser.add_argument("--reports", type=str, help="CT-RATE's table of reports, or the folder it is in")
    for name, hint in get_type_hints(CTSource).items():
        parser.add_argument(f"--source.{name}", type=hint | None, help="as --data.source of test")
    parser.add_argument("--set", nargs="+", action="extend", metavar="NAME=VALUE",
                        help="settings instead of the file's; a list is an axis: --set "
                             "method=[sirt,my_module.MySampler] views=4 projector=siddon; of one of the file's changed "
                             "methods as --set X2CT.method.file=x2ct.safetensors")
    parser.add_argument("--metrics", type=list[str],
                        help=f"what is measured, instead of the file's: a list of {', '.join(METRICS)}")
    parser.add_argument("--out", type=str, help="folder of the results, instead of the file's")
    parser.add_argument("--keep_volumes", action="store_true",
                        help="keep each row's volume, in volumes/<key>, and show it on the page")
    parser.add_argument("--device", type=str, help="cpu or cuda; left out: cuda where there is one")
    add_progress_options(parser)
    words = {word for arg in args for word in re.findall(r"\w+", arg)}
    for name in reversed([name for name in METHODS if name in words]):
        show_settings(parser, name, METHODS[name], "method")
    return parser
