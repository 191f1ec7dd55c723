"""Writes the tables of TRUST.md, each behind its mark `<!-- name -->`, anew from the CSVs in this folder.

    python tests/benchmark/trust.py
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from statistics import mean

from phydict.evaluation import read_csv

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "TRUST.md"
NOTICED = (
    "eight views", "view 3 flipped", "view 3 shifted by 5 pixels", "view 3 rotated by 2 degrees",
    "view 2 in the place of view 3", "view 3 blank", "display values taken for line integrals",
    "line integrals 10 times too small", "decadic logarithms", "line integrals twice too large",
    "truncated: 1.4 times the patient", "truncated by a narrow detector",
    "water of 0.025 / mm assumed", "arc of 60 degrees", "two views", "metal", "10 % noise", "all water",
    "heel effect of 30 %", "detector blur of 3 mm", "detector lag of 5 %", "patient of 55 cm", "patient mirrored",
    "breathing by 10 mm")
"""Cases of hard_cases.csv that stand in the page."""

SAID_OF = {"true": "true, which no one knows", "tags": "as the tags say", "calibrated": "`--calibrate`"}
"""What the page calls the geometries of radiographs.csv."""


def rows_of(file: str, **wanted: object) -> list[dict]:
    return [row for row in read_csv(HERE / file) if all(row.get(name) == value for name, value in wanted.items())]


def values(rows: Iterable[dict], column: str, scale: float = 1.0) -> list[float]:
    return [scale * float(row[column]) for row in rows if row.get(column) not in (None, "")]


def shown(found: list[float], worst: Callable[[list[float]], float], digits: int = 0) -> str:
    """The mean and, in brackets, the worst of some numbers."""
    average, least = (round(value, digits) + 0.0 for value in (mean(found), worst(found)))  # no -0
    return f"{average:.{digits}f} ({least:.{digits}f})"


def table(head: str, rows: Iterable[tuple]) -> str:
    names = head.split(" | ")
    lines = [names, ["---", *["---:"] * (len(names) - 1)], *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def scenes(rows: list[dict], *columns: str) -> Iterator[tuple[tuple, list[dict]]]:
    """Rows by what they have in some columns, in their order."""
    for place in dict.fromkeys(tuple(map(row.get, columns)) for row in rows):
        yield place, [row for row in rows if tuple(map(row.get, columns)) == place]


def errors() -> str:
    rows = rows_of("refiner/results.csv", method="phydict_learned")
    return table("X-rays | K | body | lungs | whole volume", (
        (simulator + (f", {int(voxels)}^3" if voxels else ""), int(views),
         *(shown(values(own, f"mae_hu{part}"), max) for part in ("_body", "_lung", "")))
        for (simulator, voxels, views), own in scenes(rows, "simulator", "simulation_voxels", "views")))


def intervals() -> str:
    def cells(own: list[dict], part: str) -> tuple:
        own = [row for row in own if row["part"] == part]
        return shown(values(own, "inside_90", 100), min), f"{mean(values(own, 'half_width_90_hu')):.0f} HU"

    rows = rows_of("uncertainty.csv")
    return table("X-rays | K | body: inside | half-width | lungs: inside | half-width | body: rank", (
        (scene, int(views), *cells(own, "body"), *cells(own, "lung"),
         f"{mean(values((row for row in own if row['part'] == 'body'), 'rank_correlation')):.2f}")
        for (scene, views), own in scenes(rows, "scene", "views")))


def geometries() -> str:
    rows = rows_of("geometry/results.csv", method="phydict_learned")
    whole = {row["case"]: float(row["psnr_body"]) for row in rows if row["geometry"] == "paper_orbit"}

    def lost(own: list[dict]) -> list[float]:
        return [whole[row["case"]] - float(row["psnr_body"]) for row in own]

    return table("geometry | K | PSNR body | lost (gained: negative)", (
        (f"`{name}`", int(views), shown(values(own, "psnr_body"), min, 1),
         "" if name == "paper_orbit" else shown(lost(own), max, 1))
        for (name, views), own in scenes(rows, "geometry", "views")))


def poses() -> str:
    columns = (*(f"psnr{part}_{of}" for part in ("", "_body") for of in ("correct", "wrong", "calibrated")),
               "reprojection_mm_before", "reprojection_mm")
    return table("errors | K | CTs | PSNR: right geometry | wrong | calibrated | PSNR body: right geometry | wrong | "
                 "calibrated | mm before | mm after", (
        (kind, int(views), len(own), *(f"{mean(values(own, column)):.1f}" for column in columns))
        for (kind, views), own in scenes(rows_of("poses.csv", method="phydict_learned"), "errors", "views")))


def radiographs() -> str:
    rows = [row for row in rows_of("radiographs.csv", method="phydict_learned") if row["case"] != "release"]
    return table("geometry | PSNR body (dB) | body: inside 90 % | lungs: inside 90 % | half-width (HU) | misfit", (
        (SAID_OF[geometry], shown(values(own, "psnr_body"), min, 1), shown(values(own, "inside_90_body", 100), min),
         shown(values(own, "inside_90_lung", 100), min), f"{mean(values(own, 'half_width_90_hu')):.0f}",
         f"{mean(values(own, 'misfit')):.3f}") for (geometry,), own in scenes(rows, "geometry")))


def noticed() -> str:
    rows = {row["case"]: row for row in rows_of("hard_cases.csv", method="phydict_learned")}
    lines = []
    for case in NOTICED:
        row = rows[case]
        said = str(row.get("said") or "")
        numbers = [f"{scale * float(row[name]):.{digits}f}" if row.get(name) not in (None, "") else ""
                   for name, scale, digits in (
                       ("psnr", 1, 1), ("psnr_body", 1, 1), ("misfit", 1, 4), ("inside_90", 100, 0))]
        lines.append((case, *numbers, "refused" if said.startswith("refused") else "yes" if said else "no"))
    return table("case | PSNR (dB) | PSNR body | misfit | body: inside 90 % | noticed", lines)


def reports() -> str:
    rows = rows_of("text.csv", prior="refiner_64")
    return table("K | report | error (HU) | whole volume: PSNR (dB) | PSNR body", (
        (int(views), case, f"{mean(values(own, 'region_mae_hu')):.0f}",
         *(f"{mean(values(own, column)):.2f}" for column in ("psnr", "psnr_body")))
        for (views, case), own in scenes(rows, "views", "method")))


TABLES = {made.__name__: made for made in (
    errors, intervals, geometries, poses, radiographs, noticed, reports)}


def filled(page: str) -> str:
    """The page with its tables made anew."""
    def replaced(mark: re.Match) -> str:
        return f"{mark[1]}\n{TABLES[mark[2]]()}\n\n"

    return re.sub(r"(<!-- (\w+) -->)\n(?:\|.*\n)*\n", replaced, page)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
    print(f"{len(TABLES)} tables in {PAGE}")
