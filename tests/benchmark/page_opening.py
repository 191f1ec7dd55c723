"""Seconds until a page of results is there in a browser, against the number of its cases.

    python tests/benchmark/page_opening.py <folder of one finished case of predict, test or ablate>

The case stands for all, under other names. Each page is opened --rounds times from disk, in turns, in a Chromium
without a window. Writes page_opening.csv beside this file, medians: open_s until every row of the table is laid out,
case_s from there until a case's volume is shown; and the page's size.
"""

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median

from playwright.sync_api import Browser, sync_playwright

from phydict.evaluation import write_csv
from phydict.inference.page import results_page
from phydict.inference.results import RECORD

FILE = Path(__file__).with_suffix(".csv")
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CASES = (1, 20, 200, 1000)


def copies(case: Path, number: int, out: Path) -> Path:
    """The page of `number` cases that are all like `case`."""
    record = json.loads((case / RECORD).read_text())
    for name in map(str, range(number)):
        folder = out / record["method"] / name
        shutil.copytree(case, folder, copy_function=os.link, ignore=shutil.ignore_patterns(RECORD))
        (folder / RECORD).write_text(json.dumps(record | {"case": name}))
    return results_page(out)


def opening(browser: Browser, file: Path, number: int) -> tuple[float, float]:
    page = browser.new_page()
    begun = time.perf_counter()
    page.goto(file.as_uri())
    page.wait_for_function("number => document.querySelectorAll('tr[data-key]').length === number && "
                           "document.body.getBoundingClientRect().height > 0", arg=number)
    opened = time.perf_counter()
    page.locator("tr[data-key] button.name").first.click()
    page.wait_for_selector("#viewer:not([hidden])")
    page.wait_for_function("document.getElementById('state').textContent === ''")
    shown = time.perf_counter()
    page.close()
    return opened - begun, shown - opened


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        parser.error(f"no browser is installed: one of {', '.join(BROWSERS)} is needed")
    with tempfile.TemporaryDirectory(dir=given.case.parent) as folder, sync_playwright() as driver:
        files = {number: copies(given.case, number, Path(folder) / str(number)) for number in CASES}
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        rounds = [{number: opening(browser, file, number) for number, file in files.items()}
                  for _ in range(given.rounds)]
        browser.close()
        rows = [{"cases": number, "rounds": given.rounds,
                 **{name: median(times[number][i] for times in rounds) for i, name in enumerate(("open_s", "case_s"))},
                 "page_bytes": file.stat().st_size} for number, file in files.items()]
    write_csv(FILE, rows)
    print(*rows, sep="\n")
