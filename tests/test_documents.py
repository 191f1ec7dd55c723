"""What the documents say is so: links lead somewhere, figures are those of the CSVs, names and versions are today's."""

import ast
import re
import runpy
import statistics
from pathlib import Path

import pytest
import yaml

import phydict
from phydict.evaluation import read_csv

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / name for name in (
    "README.md", "TRUST.md", "CHANGELOG.md", "CONTRIBUTING.md", "configs/README.md", "data/README.md",
    "data/prior/README.md", "data/rivals/README.md", "data/spectra/README.md", "tests/benchmark/README.md")]
DOCUMENTS += sorted((ROOT / "data" / "example").glob("*/README.md"))
README = DOCUMENTS[0].read_text()


def prose(file: Path) -> str:
    """A document without its code."""
    return re.sub(r"^```.*?^```", "", file.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(file: Path) -> set[str]:
    """The names by which a document's headings are linked."""
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-")
            for heading in re.findall(r"^#+ (.*)$", prose(file), flags=re.MULTILINE)}


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda f: str(f.relative_to(ROOT)))
def test_a_link_leads_to_a_file_and_a_heading_that_are_there(file):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(file)):
        place, _, anchor = link.partition("#")
        target = (file.parent / place).resolve() if place else file
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("file", sorted((ROOT / "phydict/posterior/samplers").glob("*.py")), ids=lambda f: f.stem)
def test_the_table_of_a_samplers_docstring_is_in_line(file):
    table = [line for line in (ast.get_docstring(ast.parse(file.read_text())) or "").splitlines() if line[:1] == "|"]
    edges = [at for at, mark in enumerate(table[0]) if mark == "|"] if table else []
    assert all(len(line) == len(table[0]) and {line[at] for at in edges} == {"|"} for line in table)


def test_the_readme_is_short_and_names_every_method():
    assert README.count("\n") <= 150
    assert all(f"`{name}`" in README for name in phydict.METHODS)


def test_the_readmes_results_are_those_of_their_tables():
    views, refiner = (read_csv(ROOT / "tests" / "benchmark" / name / "results.csv") for name in ("views", "refiner"))
    refiner = [row for row in refiner if row["simulator"] == "ideal" and "simulation_voxels" not in row]
    rows = [row for row in views if row["method"] != "phydict_fast"] + refiner
    shown = re.findall(r"^\| (.+?) " + r"\| \**([\d. /]+\d)\** " * 4 + r"\|$", README, flags=re.MULTILINE)
    assert len(shown) == 4 and {name for name, *_ in shown} == {
        row["method"] for row in rows if int(row["views"]) <= 8} - {"sirt", "tv"}
    for name, *cells in shown:
        for views, cell in zip((1, 2, 4, 8), cells, strict=True):
            of = [row for row in rows if row["method"] == name and int(row["views"]) == views]
            psnr, ssim, body = (statistics.mean(row[key] for row in of) for key in ("psnr", "ssim", "psnr_body"))
            assert cell == f"{psnr:.2f} / {ssim:.3f} / {body:.2f}", (name, views)
    seconds = [float(row["seconds"]) for row in refiner if int(row["views"]) <= 8]
    assert f"take {min(seconds):.1f} to {max(seconds):.1f} s per volume" in README
    fine = [[mean_psnr(read_csv(ROOT / "tests" / "benchmark" / "grid" / "results.csv"), name, views)
             for views in (2, 4, 8)] for name in ("phydict_learned", "tv, weight for 3 mm")]
    ours, tv = (" / ".join(f"{psnr:.2f}" for psnr in of) for of in fine)
    assert f"K = 2 / 4 / 8: {ours} dB**, tv at twice its weight {tv}." in " ".join(README.split())
    paper = [row for row in read_csv(ROOT / "tests" / "benchmark" / "table1" / "results.csv")
             if row["simulator"] == "ideal"]
    told = ", ".join(f"{said} {mean_psnr(paper, name, 8):.2f}" for name, said in {
        "phydict_learned": "phydict_learned", "DAPS": "DAPS", "X2CT": "X2CT", "Ours": "the paper's method"}.items())
    assert f"from eight views: {told} dB;" in " ".join(README.split())


def mean_psnr(rows: list[dict], name: str, views: int) -> float:
    return statistics.mean(float(row["psnr"]) for row in rows if row["method"] == name and int(row["views"]) == views)


def test_the_table_of_other_couches_is_that_of_its_csv():
    rows = read_csv(ROOT / "tests" / "benchmark" / "couches.csv")
    page = (ROOT / "tests" / "benchmark" / "README.md").read_text()
    section = page.partition("## Other couches")[2].partition("\n## ")[0]
    shown = re.findall(r"^\| (.+?) \| (\d+) " + r"\| \**([\d.]+)\** " * 3 + r"\|", section, flags=re.MULTILINE)
    assert {(name, int(views)) for name, views, *_ in shown} == {(row["method"], row["views"]) for row in rows}
    for name, views, *cells in shown:
        of = [row for row in rows if (row["method"], row["views"]) == (name, int(views))]
        means = [statistics.mean(row[key] for row in of) for key in ("psnr", "ssim", "psnr_body")]
        assert cells == [f"{mean:.{digits}f}" for mean, digits in zip(means, (2, 3, 2))], (name, views)


def test_the_tables_of_how_far_to_trust_it_are_those_of_their_csvs():
    page = ROOT / "TRUST.md"
    trust = runpy.run_path(str(ROOT / "tests" / "benchmark" / "trust.py"))
    assert all(f"<!-- {name} -->\n| " in page.read_text() for name in trust["TABLES"])
    assert trust["filled"](page.read_text()) == page.read_text(), "run python tests/benchmark/trust.py"


@pytest.mark.parametrize("page", ["TRUST.md", "tests/benchmark/hard_cases.md"])
def test_what_stands_of_the_whole_volume_stands_of_the_body_too(page):
    heads = [line for line in (ROOT / page).read_text().splitlines() if line.startswith("|") and "PSNR" in line]
    assert heads and all("PSNR body" in head for head in heads)


def test_the_citation_and_the_changelog_are_of_this_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == phydict.__version__
    versions = re.findall(r"^## ([\d.]+)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert versions[0] == phydict.__version__
