"""The CSV loses nothing and is never half written; the Markdown table marks what is best."""

from __future__ import annotations

import errno
import io
import math
import os
import random
import re
import stat

import pytest
import torch
from rich.console import Console

from phydict.evaluation import Table, mean_table, read_csv, summarise, write_csv
from phydict.evaluation.metrics import MEASURES, Measure
from phydict.evaluation.tables import ranks
from phydict.runtime.files import alone_in, atomic_directory, atomic_write, remove_leftovers
from phydict.units import HUWindow

ROWS = [
    {"case": "007", "method": "fdk", "ssim": 0.5, "psnr": 20.0, "mae_hu": 80.0, "seconds": 1.0},
    {"case": "008", "method": "fdk", "ssim": 0.7, "psnr": 24.0, "mae_hu": 60.0, "seconds": 1.0},
    {"case": "007", "method": "gibbs", "ssim": 0.8, "psnr": 27.0, "mae_hu": 30.0, "seconds": 90.0},
    {"case": "008", "method": "gibbs", "ssim": 0.9, "psnr": 29.0, "mae_hu": 20.0, "seconds": 70.0},
]
STATED = [row | {"grid": "64x64x64", "views": 8} for row in ROWS]


def test_a_name_that_is_no_utf_8_is_written_as_far_as_it_is(tmp_path):
    write_csv(tmp_path / "t.csv", [{"case": "a", "geometry": os.fsdecode(b"caf\xe9.yaml")}])
    assert read_csv(tmp_path / "t.csv") == [{"case": "a", "geometry": "caf?.yaml"}]


def test_csv_round_trip_keeps_every_digit_and_kind(tmp_path):
    rows = [{"case": "007", "method": "1", "psnr": 0.1 + 0.2, "seed": 3, "note": "a,\"b\"\nc", "code": "0012"},
            {"case": "x", "method": "tv", "psnr": math.inf, "ssim": 1e-17}]
    write_csv(tmp_path / "new" / "t.csv", rows)
    assert read_csv(tmp_path / "new" / "t.csv") == rows


def test_tensors_become_numbers_and_none_becomes_absent(tmp_path):
    write_csv(tmp_path / "t.csv", [{"case": "a", "psnr": torch.tensor(1.5), "ssim": None, "lpips": math.nan}])
    (row,) = read_csv(tmp_path / "t.csv")
    assert row["psnr"] == 1.5 and "ssim" not in row and math.isnan(row["lpips"])


def test_columns_are_the_union_with_case_and_method_first(tmp_path):
    write_csv(tmp_path / "t.csv", [{"psnr": 1.0, "case": "a"}, {"ssim": 0.5, "method": "m", "case": "b"}])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["case,method,psnr,ssim", "a,,1.0,", "b,m,,0.5"]


def test_appending_reads_the_old_rows_and_adds_columns(tmp_path):
    path = tmp_path / "t.csv"
    for row in [*ROWS, {"case": "009", "method": "fdk", "lpips": 0.25}]:
        write_csv(path, [*read_csv(path), row])
    assert read_csv(path) == [*ROWS, {"case": "009", "method": "fdk", "lpips": 0.25}]


def test_a_truncated_file_is_named(tmp_path):
    path = tmp_path / "t.csv"
    write_csv(path, ROWS)
    path.write_text(path.read_text()[:-12])
    with pytest.raises(ValueError, match="line 5 .* cut off"):
        read_csv(path)


def test_a_spreadsheets_mark_of_utf_8_is_no_part_of_the_first_columns_name(tmp_path):
    path = tmp_path / "t.csv"
    write_csv(path, ROWS)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_csv(path) == ROWS


def test_a_column_that_is_there_twice_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("case,method,psnr,psnr\na,sirt,20.0,30.0\n")
    with pytest.raises(ValueError, match=r"t\.csv has the column 'psnr' twice"):
        read_csv(tmp_path / "t.csv")


def test_an_error_while_writing_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    write_csv(path, ROWS[:1])
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_csv(path, ROWS)
    assert read_csv(path) == ROWS[:1] and os.listdir(tmp_path) == ["t.csv"]


def test_a_process_killed_while_writing_leaves_the_old_file_and_the_next_run_nothing_else(tmp_path):
    path = tmp_path / "t.csv"
    write_csv(path, ROWS[:1])
    child = os.fork()
    if child == 0:
        os.fsync = lambda _: os.kill(os.getpid(), 9)
        write_csv(path, ROWS)
        os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == 9
    assert read_csv(path) == ROWS[:1] and len(os.listdir(tmp_path)) == 2
    (tmp_path / f".elsewhere.{child}.part.t.csv").touch()  # another machine's, which may live
    with alone_in(tmp_path, "out"), atomic_write(tmp_path / "now.csv") as part:
        part.touch()
        remove_leftovers(tmp_path)
    assert {*os.listdir(tmp_path)} == {"t.csv", "now.csv", ".lock", f".elsewhere.{child}.part.t.csv"}


def test_a_file_is_written_where_the_file_system_syncs_no_folders(tmp_path, monkeypatch):
    sync = os.fsync

    def of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        sync(handle)

    monkeypatch.setattr(os, "fsync", of_files)
    write_csv(tmp_path / "t.csv", ROWS)
    with atomic_directory(tmp_path / "case") as partial:
        write_csv(partial / "t.csv", ROWS)
    assert read_csv(tmp_path / "case" / "t.csv") == read_csv(tmp_path / "t.csv") == ROWS


def test_a_file_that_the_disk_did_not_take_does_not_replace_another(tmp_path, monkeypatch):
    def failing(handle: int) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    write_csv(tmp_path / "t.csv", ROWS)
    monkeypatch.setattr(os, "fsync", failing)
    with pytest.raises(OSError, match="Invalid argument"):
        write_csv(tmp_path / "t.csv", ROWS[:1])
    assert read_csv(tmp_path / "t.csv") == ROWS and os.listdir(tmp_path) == ["t.csv"]


def test_what_a_container_with_the_name_of_this_machine_writes_is_left_alone(tmp_path, monkeypatch):
    dead = 99_999_999  # here; there it is another process
    with monkeypatch.context() as there:
        (tmp_path / "numbering").touch()
        there.setattr("phydict.runtime.files.NUMBERING", tmp_path / "numbering")
        there.setattr(os, "getpid", lambda: dead)
        file, folder = atomic_write(tmp_path / "t.csv"), atomic_directory(tmp_path / "case")
        parts = [file.__enter__(), folder.__enter__()]
        parts[0].touch()
    remove_leftovers(tmp_path)
    assert all(part.exists() for part in parts)
    for writing in (file, folder):
        writing.__exit__(None, None, None)
    assert {*os.listdir(tmp_path)} == {"numbering", "t.csv", "case"}


def cells(rows: list[dict]) -> dict[str, dict[str, str]]:
    """{row name: {column name without its arrow: cell}} of the Markdown table of some rows."""
    lines = [[c.strip() for c in line.strip("| ").split(" | ")]
             for line in mean_table(rows).markdown().splitlines() if line.startswith("|")]
    names = [re.sub(" (↑|↓|→ 1)$", "", name) for name in lines[0]]
    return {line[0]: dict(zip(names, line)) for line in lines[2:]}


def test_bold_marks_the_best_in_the_right_direction():
    table = cells(ROWS)
    assert table["gibbs"]["SSIM"] == "**0.850 ± 0.071 [0.800, 0.900]**"
    assert table["fdk"]["SSIM"] == "<u>0.600 ± 0.141 [0.500, 0.700]</u>"
    assert table["gibbs"]["PSNR (dB)"] == "**28.00 ± 1.41 [27.00, 29.00]**"
    assert table["gibbs"]["MAE (HU)"] == "**25.0 ± 7.1 [20.0, 30.0]**" and "**" not in table["fdk"]["MAE (HU)"]
    assert table["fdk"]["time (s)"] == "**1.00 ± 0.00 [1.00, 1.00]**" and "**" not in table["gibbs"]["time (s)"]


def test_ranks_follow_the_direction_and_the_printed_values():
    draw = random.Random(0)
    for _ in range(200):
        values = [draw.choice([draw.random(), 0.5, math.nan]) for _ in range(draw.randint(0, 6))]
        known = sorted(v for v in values if not math.isnan(v))
        places = ranks(values, Measure("low", False, 20))
        assert places == ranks([-v for v in values], Measure("high", True, 20))
        assert places == ranks([draw.choice([3 - v, 3 + v]) for v in values], Measure("right", None, 12, target=3.0))
        unlike = len(set(known)) > 1
        assert [v for v, place in zip(values, places) if place == 1] == (
            known[:known.count(known[0])] if unlike else [])
        seconds = {v for v, place in zip(values, places) if place == 2}
        assert seconds == ({known[1]} if unlike and known[1] > known[0] else set())
        assert ranks(values, Measure("neither", None, 20)) == [0] * len(values)


def test_the_best_is_bold_and_the_second_underlined_by_what_is_printed():
    table = Table("T_1 $", ["method", "PSNR", "MAE"], [MEASURES["psnr"], MEASURES["mae_hu"]],
                  [("a_b", True, [20.001, 9.0]), ("b", True, [30.0, 5.0]), ("c", False, [40.0, 1.0]),
                   ("d", True, [20.0, None])], ["100 %"])
    lines = table.markdown().splitlines()
    assert lines[4:8] == ["| a_b | <u>20.00</u> | <u>9.0</u> |", "| b | **30.00** | **5.0** |", "| c | 40.00 | 1.0 |",
                          "| d | <u>20.00</u> | – |"]
    tex = table.latex()
    assert "a\\_b & \\underline{20.00} & \\underline{9.0} \\\\" in tex and "b & \\textbf{30.00} & \\textbf{5.0}" in tex
    assert "T\\_1 \\$. 100 \\%" in tex and "d & \\underline{20.00} & --" in tex


NAME = "s|<b>$x$_%&*\\`"


def test_a_name_is_text_in_markdown_and_latex_whatever_its_letters():
    table = Table(NAME, [NAME], [], [(NAME, True, [])], [NAME])
    text = "s|&lt;b&gt;\\$x\\$_%&amp;\\*\\\\\\`"
    cell = text.replace("|", "\\|")
    assert table.markdown() == f"### {text}\n\n| {cell} |\n| --- |\n| {cell} |\n\n{text}\n\n"
    tex = "s\\textbar{}\\textless{}b\\textgreater{}\\$x\\$\\_\\%\\&*\\textbackslash{}`"
    assert table.latex().count(tex) == 4


@pytest.mark.parametrize("name", [name for name, measure in MEASURES.items() if measure.higher_is_better is not None])
def test_every_known_metric_has_its_direction(name):
    good_when_low = {"mae_hu", "mae_hu_body", "mae_hu_lung", "lpips_alex", "lpips_squeeze", "hd95_lung", "misfit",
                     "seconds"}
    table = cells([{"case": "a", "method": "low", name: 1.0}, {"case": "a", "method": "high", name: 2.0}])
    best = "low" if name in good_when_low else "high"
    assert [row for row, values in table.items() if "**" in list(values.values())[1]] == [best]


def test_the_nearest_to_the_right_value_is_the_best_on_either_side_of_it():
    named = {"edge_diaphragm", "edge_chest_wall", "ribs", "vessels"}
    assert {name for name, measure in MEASURES.items() if measure.target == 1} == named
    for name in named:
        table = mean_table([{"case": "a", "method": str(value), name: value} for value in (1.4, 0.9, 1.1, 1.0, 0.5)])
        assert {label: place for (label, _, _), ((_, place),) in zip(table.lines, table.cells())} == {
            "1.0": 1, "0.9": 2, "1.1": 2, "1.4": 0, "0.5": 0}
        assert table.header[1].endswith(" → 1") and "$\\rightarrow$ 1" in table.latex()


def test_a_column_of_equal_values_has_no_best():
    table = cells([{"case": "a", "method": method, "dice_lung": 0.0, "psnr": psnr, "ssim": ssim}
                   for method, psnr, ssim in (("x", 1.0, math.nan), ("y", 2.0, 0.5))])
    assert [table[method]["Dice lungs"] for method in "xy"] == ["0.000", "0.000"]
    assert table["y"]["PSNR (dB)"] == "**2.00**" and table["y"]["SSIM"] == "0.500"


def test_ties_share_the_place_and_failures_never_win():
    rows = [{"case": "a", "method": m, "psnr": p} for m, p in
            [("x", 20.001), ("y", 20.002), ("failed", math.nan), ("worse", 10.0)]]
    table = cells(rows)
    assert [m for m in table if "**" in table[m]["PSNR (dB)"]] == ["x", "y"]
    assert table["failed"]["PSNR (dB)"] == "nan"


def test_the_caption_states_range_grid_views_and_cases():
    text, interval = mean_table(STATED).notes
    assert "bootstrap over 2 patients." in interval and len(mean_table(STATED[::2]).notes) == 1
    for part in ("n = 2 cases", "[-1000, 1000]", "2000 HU", "Grid: 64x64x64.", "Views: 8."):
        assert part in text
    assert "Views: not stated" in mean_table(ROWS).notes[0]
    assert "Views: 4, 8" in mean_table([{**row, "views": v} for row in ROWS for v in (4, 8)]).notes[0]
    assert "[-900, 700], data range 1600 HU" in mean_table(ROWS, window=HUWindow(-900, 700)).notes[0]


def of_cases(*names: str) -> str:
    """The notes of a table of these cases."""
    rows = [{"case": name, "method": "m", "psnr": 20.0 + n} for n, name in enumerate(names)]
    return "\n".join(mean_table(rows).notes)


def test_intervals_name_the_number_of_patients_and_what_names_these():
    named = "whom the first folder or CT-RATE's number names."
    assert "bootstrap over 3 patients." in of_cases("a", "b", "c")
    for pair in (("p__a", "p__b"), ("train_1_a_1", "train_1_b_1")):
        assert f"bootstrap over 2 patients, {named}" in of_cases(*pair, "c")
        assert f"No intervals: all cases are of one patient, {named}" in of_cases(*pair)
    assert "patient" not in of_cases("p__a")


def test_a_single_case_is_one_case_and_what_ranks_nothing_says_nothing_of_marks():
    assert of_cases("a").startswith("One case. HU clipped") and "n = 2 cases. HU" in of_cases("a", "b")
    assert mean_table(ROWS[::2]).notes[0].startswith("One case; best in bold, second underlined. HU clipped")


def test_seconds_with_first_calls_are_neither_ranked_nor_have_an_interval():
    table = mean_table(ROWS, first_calls=True)
    times = [line.split(" | ")[-1] for line in table.markdown().splitlines() if line.startswith("| ")]
    assert times == ["time (s) |", "---: |", "1.00 ± 0.00 |", "80.00 ± 14.14 |"]
    assert [note for note in table.notes if note.startswith("Seconds: first calls included")]
    assert "first calls" not in mean_table(ROWS).markdown()


def test_the_caption_tells_when_methods_had_different_cases():
    assert "n = 1 to 2 cases (not the same cases in every line)" in mean_table(ROWS[:3]).notes[0]
    assert "not the same" not in mean_table(ROWS).notes[0]


def test_a_column_of_unlike_cases_ranks_nothing_and_the_others_do():
    rows = [*ROWS[:3], {name: value for name, value in ROWS[3].items() if name != "ssim"}]
    marked = {name for line in cells(rows).values() for name, cell in line.items() if re.search("[*]|<u>", cell)}
    assert marked == {"PSNR (dB)", "MAE (HU)", "time (s)"} and "| SSIM ↑ |" in mean_table(rows).markdown()
    assert not re.search("[*]|<u>", mean_table(ROWS[:3]).markdown())


def test_cases_are_told_apart_by_numbers_as_by_words_and_rows_without_are_the_methods_first_second_and_so_on():
    words = mean_table(ROWS).markdown()
    assert mean_table([row | {"case": int(row["case"])} for row in ROWS]).markdown() == words
    assert mean_table([{name: value for name, value in row.items() if name != "case"} for row in ROWS]
                      ).markdown() == words


def test_warnings_are_counted_in_the_line_and_name_their_cases_in_the_caption():
    rows = [row | ({"warning": "no lungs"} if row["case"] == "008" and row["method"] == "fdk" else {}) for row in ROWS]
    table = cells(rows)
    assert (table["fdk"]["warned"], table["gibbs"]["warned"]) == ("1", "0")
    assert mean_table(rows).notes[2:] == ["Doubtful cases, by the column warning: fdk: 008."]
    assert "Doubtful" not in mean_table(ROWS).markdown() and "warned" not in mean_table(ROWS).markdown()


def test_seeds_of_a_case_are_averaged_before_cases():
    rows = [{"case": "a", "method": "m", "psnr": p} for p in (10.0, 10.0, 10.0)] + [
        {"case": "b", "method": "m", "psnr": 20.0}]
    got = summarise(rows)["m"]["psnr"]
    assert (got.mean, got.cases) == (15, {"a", "b"}) and got.std == pytest.approx(50**0.5)


def test_a_metric_that_a_method_lacks_is_a_dash():
    table = cells([*ROWS, {"case": "007", "method": "tv", "psnr": 1.0}])
    assert table["tv"]["SSIM"] == "–" and table["tv"]["PSNR (dB)"] == "1.00"


def test_a_metric_of_some_cases_says_of_how_many():
    rows = [{"case": case, "method": "m", "psnr": 20.0} | more for case, more in (("a", {"clip_t2i": 0.5}), ("b", {}))]
    said = mean_table(rows, empty={"clip_t2i": "no case has a report"}).markdown()
    assert "CLIP T2I (%): of 1 of 2 cases (m)." in said and "empty" not in said


def test_the_tables_for_console_and_latex_say_the_same():
    console = Console(width=200, record=True, file=open(os.devnull, "w"))
    console.print(mean_table(STATED))
    text = console.export_text()
    for part in ("0.850 ± 0.071 ", "25.0 ± 7.1", "MAE (HU) ↓", "[-1000, 1000]", "Views: 8"):
        assert part in text
    assert "In brackets" not in text and "[0.800" not in text  # intervals would not fit
    assert "\\textbf{0.850 $\\pm$ 0.071 [0.800, 0.900]}" in mean_table(STATED).latex()


def test_a_name_of_several_lines_or_in_brackets_is_one_line_of_the_table():
    table = mean_table([{"case": "a", "method": name, "psnr": 1.0} for name in ("one\ntwo", "[b]", "*c")])
    assert "\n| one two | 1.00 |\n| [b] | 1.00 |\n" in table.markdown()
    rows = [f"{name} & 1.00 \\\\\n" for name in ("one two", "{}[b]", "{}*c")]  # bare, \\ would take [ and * for its own
    assert "".join(rows) in table.latex()


def test_bad_requests_are_named():
    with pytest.raises(ValueError, match="no rows"):
        mean_table([])
    with pytest.raises(ValueError, match="the column 'method'"):
        mean_table([{"psnr": 30.0}])
    with pytest.raises(ValueError, match="psnr of a by tv is '20,5', which is no number"):
        mean_table([{"case": "a", "method": "tv", "psnr": "20,5"}])


@pytest.mark.parametrize("content", [b"case,method\n" + b"x" * 200_000 + b",y\n", bytes(range(256)),
"case\n".encode("utf-16")],
                         ids=["long", "binary", "UTF-16"])
def test_what_is_no_table_is_one_sentence_that_names_the_file(tmp_path, content):
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"t\.csv cannot be read .*; repair or remove it$"):
        read_csv(tmp_path / "t.csv")


@pytest.mark.parametrize("width", [80, 120, 400])
def test_the_console_shows_every_value_whole_however_many_measures_there_are(width):
    rows = [{"case": str(n), "method": "phydict_fast", **{name: 10.0 * i + n for i, name in enumerate(MEASURES)}}
            for n in range(3)]
    console = Console(width=width, file=io.StringIO())
    console.print(table := mean_table(rows))
    shown = console.file.getvalue()
    assert "…" not in shown and all(name in shown for name in table.header)
    assert all(f"{float(value):.{measure.decimals}f}" in shown
               for value, measure in zip(table.lines[0][2], table.measures))


def test_brackets_in_a_case_are_no_markup_of_the_console():
    console = Console(width=400, file=io.StringIO())
    console.print(mean_table([{"case": "[/b]", "method": "a", "psnr": 3.0, "warning": "x"}]))
    assert "[/b]" in console.file.getvalue()
