"""What tables and plots make of the rows of an ablation."""

from __future__ import annotations

import random

import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ablation.runs import ablate, row
from phydict.ablation import plots
from phydict.ablation.fid import FID, distance_tables, write_distances
from phydict.ablation.results import features_file
from phydict.ablation.summary import conditions, summarise, without_repeats
from phydict.ablation.tables import all_tables
from phydict.datasets.cts.ct_rate import patient_of
from phydict.evaluation import read_csv, write_csv
from phydict.evaluation.backbones import DIMENSIONS
from phydict.evaluation.fid import NAMES, save_features
from phydict.evaluation.planes import PLANES
from phydict.inference.scoring import FIDSettings, Scoring


def test_a_case_counts_once_whatever_its_seeds_and_a_missing_case_takes_a_method_out():
    rows = [row("a", "x", 10.0), row("a", "x", 20.0, seed=1), row("b", "x", 35.0), row("a", "y", 39.0),
            row("b", "y", None), row("a", "z", 5.0), row("b", "z", 5.0)]
    x, y, z = summarise(rows)
    assert x.means["psnr"] == 25.0 and x.complete and not y.complete and y.label == "y (1 of 2 cases)"
    table, differences = all_tables([x, y, z])
    text = table.markdown()
    assert "| x | **0.625 [0.375, 0.875]** | **25.00 [15.00, 35.00]** |" in text
    assert "| y (1 of 2 cases) | 0.975 | 39.00 |" in text
    assert "y: refused: no." in text and "| z | <u>0.125 [0.125, 0.125]</u> |" in text
    assert differences.title == "Methods, K = 8, ideal: less x, case by case"  # y lacks a case
    assert "| y (1 of 2 cases) | 0.600 | 24.00 |" in differences.markdown()
    assert "| z | -0.500 [-0.750, -0.250] | -20.00 [-30.00, -10.00] |" in differences.markdown()


def test_a_case_that_lacks_a_seed_does_not_count():
    rows = [row(case, method, 20.0, seed=seed) for method in "xy" for case in "ab" for seed in (0, 1)]
    rows[-1] = row("b", "y", None, seed=1)
    x, y = summarise(rows)
    assert x.complete and not y.complete and y.label == "y (1 of 2 cases)" and y.values["psnr"] == {"a": 20.0}
    assert {counted["case"] for counted in y.counted} == {"a"}


def test_what_a_method_makes_of_the_same_xrays_is_its_own_setting():
    rows = [row("a", "x", 20.0, projector="siddon"), row("a", "y", 21.0), row("a", "z", 22.0, projector="joseph"),
            row("a", "z", 23.0, projector="siddon")]
    entries = summarise(rows)
    assert [entry.label for entry in entries] == ["x", "y", "z, projector joseph", "z, projector siddon"]
    assert not any(entry.condition for entry in entries)


def test_voxels_are_a_methods_where_a_protocols_are_scored_and_else_the_xrays():
    boxes = [{}, {"voxels": 128}, {"voxels": 256, "side": 400.0}]
    scored = [row("a", method, 20.0, protocol="x2ct", **box) for method, box in zip("xyy", boxes)]
    entries = summarise(scored)
    assert [entry.label for entry in entries] == ["x", "y, voxels 128", "y, voxels 256, side 400"]
    assert not any(entry.condition for entry in entries)
    *_, first, second = summarise([*scored, *(row("a", "y", 20.0, voxels=voxels) for voxels in (64, 128))])
    assert (first.condition["voxels"], second.condition["voxels"]) == (64, 128) and not first.settings.get("voxels")


@pytest.mark.parametrize("name, values", [("grid", ("16x16x16", "24x24x24")),
                                          ("window", ("[-1000, 600]", "[-1000, 300]"))])
def test_what_was_scored_on_other_voxels_or_windows_is_neither_averaged_nor_ranked_together(name, values):
    rows = [row(case, method, 20.0 + n, **{name: value}) for value in values for n, method in enumerate("xy")
            for case in "ab"]
    entries = summarise(rows)
    assert [(entry.method, entry.condition) for entry in entries] == [
        (method, {name: value}) for value in values for method in "xy"]
    tables = all_tables(entries)
    assert [table.title for table in tables] == [title for value in values for title in (
        f"Methods, {name} {value}", f"Methods, {name} {value}: less y, case by case")]
    older = row("a", "z", 20.0, grid=rows[0]["grid"])  # which tells no window
    assert not any(entry.condition for entry in summarise([*rows[:4], older]))


def test_voxels_that_a_setting_of_the_xrays_or_a_protocol_tells_are_no_condition_of_their_own():
    rows = [row("a", "x", 20.0, grid=f"{voxels}x{voxels}x{voxels}", **{name: value}) for voxels, name, value in (
        (128, "protocol", "x2ct"), (256, "protocol", "luna16"), (32, "voxels", 32), (48, "voxels", 48))]
    assert [entry.condition for entry in summarise(rows)] == [
        {"protocol": "x2ct"}, {"protocol": "luna16"}, {"voxels": 32}, {"voxels": 48}]


def test_a_setting_of_the_xrays_that_is_not_given_means_its_default():
    defaults = {"simulator.noise": 0.005, "source_to_detector": 1020.0, "centre": (0.0, 0.0, 0.0), "pixel": 1.25}
    for name, default in defaults.items():
        other = (0.0, 0.0, 9.0) if name == "centre" else 2 * default
        for as_stored in (lambda value: value, lambda value: str(value) if isinstance(value, tuple) else value):
            rows = [row("a", "x", 20.0), row("a", "y", 21.0, **{name: as_stored(default)}),
                    *(row("a", method, 22.0, **{name: as_stored(other)}) for method in "xy")]
            first, second, *others = summarise(rows)
            assert first.condition == second.condition != others[0].condition == others[1].condition, name
    fixed = {"protocol": "x2ct", "views": 2}
    first, second, _ = summarise([row("a", "x", 20.0, **fixed), row("a", "y", 20.0, pixel=1.5625, **fixed),
                                  row("a", "x", 20.0, pixel=2.5)])
    assert first.condition == second.condition == fixed | {"pixel": 1.5625}


def test_voxels_that_are_given_and_a_methods_own_of_as_many_are_one_condition():
    rows = [row("a", "one", 20.0, grid="32x32x32", voxels=32), row("a", "two", 21.0, grid="32x32x32"),
            row("a", "two", 22.0), row("a", "two", 23.0, grid="32x32x32 of 10 mm")]
    assert [sorted(entry.method for entry in of) for _, of in conditions(summarise(rows))] == [
        ["one", "two"], ["two"], ["two"]]


def test_a_case_of_other_data_is_another_case():
    other = "train_1_a_1"
    rows = [row("a", "x", 10.0, data="d1"), row(other, "x", 20.0, data="d2"), row("b", "x", 9.0, data="d4"),
            row("a", "y", 31.0, data="d1"), row(other, "y", 40.0, data="d3"), row("b", "y", 29.0, data="d4"),
            row("a", "z", 30.0), row(other, "z", 40.0), row("b", "z", 28.0)]
    x, y, z = entries = summarise(rows)
    assert x.case_ids == z.case_ids == {"a", "b", other} and set(map(patient_of, y.case_ids)) == {"a", "b", "train_1"}
    table, differences = all_tables(entries)
    assert not table.ranks and all("neither ranked nor paired: train_1_a_1, train_1__train_1_a_1 (2)." in
                                   " ".join(of.notes) for of in (table, differences))
    assert {label: values[1].mean for label, _, values in differences.lines} == {"x": -20.5, "z": -1.0}
    assert without_repeats([*rows, rows[1] | {"data": "d9"}]) == rows


def test_rows_of_older_tables_that_tell_no_window_are_repeats_of_those_that_do():
    one, other = (row("a", "x", 10.0, window=window) for window in ("[-1000, 600]", "[-1000, 300]"))
    old = row("a", "x", 11.0)
    assert without_repeats([one, other, old]) == [one, other] and without_repeats([old, one, other]) == [old]


def test_one_case_that_no_method_has_takes_no_marks_pairs_or_plots(tmp_path):
    rows = [row(case, method, None if case == "c" else 20.0 + n, views=views)
            for n, method in enumerate("xy") for case in "abc" for views in (2, 8)]
    entries = summarise(rows)
    whole = summarise(of for of in rows if of["case"] != "c")
    for found, wanted in zip(all_tables(entries), all_tables(whole), strict=True):
        assert found.cells() == wanted.cells() and found.title == wanted.title
        assert "(2 of 3 cases)" in found.markdown()
        assert "case by case" in found.title or "Mean over 2 of 3 cases" in found.notes[0]
    names = [file.name for file in plots.write_plots(tmp_path, entries)]
    assert names == [file.name for file in plots.write_plots(tmp_path, whole)] and "views.png" in names
    rows[-1] = row("c", "y", 30.0, views=8)
    rows[-3] = row("b", "y", None, views=8)
    assert not all_tables(summarise(rows))[-1].ranks  # as many cases, but not the same


def test_every_number_against_the_views_that_is_not_of_all_cases_is_told_as_such_marked_or_not():
    lacking = {("x", "c"), ("y", "b"), ("y", "c")}
    entries = summarise(row(case, method, None if views == 8 and (method, case) in lacking else 20.0, views=views)
                        for method in "xyz" for case in "abc" for views in (2, 8))
    told = "Not of all cases: x, K = 8 (2 of 3 cases); y, K = 8 (1 of 3 cases)."
    for of in (entries[:4], entries):  # of x and y alone x is marked, beside z neither
        assert all(table.notes[-1] == told for table in all_tables(of)[-3:])


def test_pictures_that_are_no_plots_of_this_command_stay_and_its_own_too_where_cases_failed(tmp_path):
    Figure().savefig(tmp_path / "pareto_mine.png")
    (tmp_path / "stages_notes.png").write_text("no picture")
    rows = [row("a", method, 20.0 + n, views=views) for n, method in enumerate("xy") for views in (2, 8)]
    mine = {"pareto_mine.png", "stages_notes.png"}
    first = {file.name for file in plots.write_plots(tmp_path, summarise(rows))}
    failed = [row("a", method, None, views=views) for method in "xy" for views in (2, 8)]
    assert plots.write_plots(tmp_path, summarise(failed)) == []
    assert {path.name for path in tmp_path.iterdir()} == first | mine
    fewer = {file.name for file in plots.write_plots(tmp_path, summarise(of for of in rows if of["views"] == 2))}
    assert {path.name for path in tmp_path.iterdir()} == fewer | mine and not fewer & first


def test_a_table_tells_methods_whose_rows_were_computed_in_several_precisions():
    rows = [row(case, method, 20.0, precision="bfloat16" if (case, method) == ("b", "x") else "float32")
            for method in "xy" for case in "ab"]
    told = "Networks computed in several precisions: x float32, bfloat16; the setting precision fixes one."
    assert all(told in table.notes for table in all_tables(summarise(rows)))
    for of in rows:
        of["networks.precision"] = of["precision"]
    assert [entry.label for entry in summarise(rows)] == ["x, precision float32", "x, precision bfloat16", "y"]
    assert not any("several precisions" in note for table in all_tables(summarise(rows)) for note in table.notes)


def test_geometries_with_detectors_of_their_own_are_compared():
    rows = [row("a", "x", 20.0, geometry=name, detector=size) for name, size in (("arc.yaml", 200), ("two.yaml", 300))]
    assert "PSNR (dB) ↑ by geometry" in {table.title for table in all_tables(summarise(rows))}


def test_a_table_tells_the_settings_of_all_its_rows_that_are_no_defaults():
    shared = {"guidance": 1.0, "geometry": "arc_60", "simulator.noise": 0.2, "method.iterations": 2}
    rows = [row("a", method, 20.0, simulation_voxels=voxels, delta=0.5 if method == "y" else None, **shared)
            for method in "xy" for voxels in (128, 256)]
    for table in all_tables(summarise(rows)):
        assert "Fixed settings: iterations 2." in table.notes
    assert "Fixed" not in all_tables(summarise([row("a", method, 20.0) for method in "xy"]))[0].markdown()


ORBIT = "source to detector 1020, source to isocentre 740, detector 448 x 448, pixel 1.25 x 1.25"
OPTIMISTIC = "made on the voxels that are reconstructed, which is optimistic."


def test_a_table_says_how_its_x_rays_were_made_defaults_included_and_leaves_what_differs_to_titles_and_columns():
    def told(*changes: dict) -> set[str]:
        return {note for table in all_tables(summarise(row("a", "x", 20.0, **change) for change in changes))
                for note in table.notes if note.startswith("X-rays: ")}

    assert told({}) == {f"X-rays: Ideal, noise 0.005, K = 8, {ORBIT}; {OPTIMISTIC}"}
    polychromatic, ideal = sorted(told({"simulator": "polychromatic", "simulator.scatter": 0.3}, {}), reverse=True)
    assert "Polychromatic, kvp 120" in polychromatic and "scatter 0.3" in polychromatic and "K = 8" in polychromatic
    assert ideal == f"X-rays: Ideal, noise 0.005, K = 8, {ORBIT}; {OPTIMISTIC}"
    finer = {"simulation_voxels": 128, "geometry": "arc_60", "simulator.noise": 0.2}
    assert told(finer) == {"X-rays: Ideal, noise 0.2, K = 8, geometry arc_60; made on 128^3 voxels."}
    assert told(*({"views": views} for views in (2, 8))) == {
        f"X-rays: Ideal, noise 0.005, {k}{ORBIT}; {OPTIMISTIC}" for k in ("K = 2, ", "K = 8, ", "")}
    (box,) = told({"voxels": "(16, 16, 8)", "side": 96.0, "centre": "(60.0, 0.0, 0.0)"})  # as a CSV holds them
    assert box.endswith("; made on 64^3 voxels of 6 mm.")
    (protocol,) = told({"protocol": "x2ct", "views": 2})
    assert "noise 0, K = 2, source to detector 949" in protocol and protocol.endswith("made on the protocol's voxels.")


def test_differences_of_a_measure_whose_right_value_is_1_are_of_its_distance_from_it():
    rows = [row(case, method, psnr, ribs=ribs) for case in "ab"
            for method, psnr, ribs in (("best", 30.0, 0.9), ("sharp", 20.0, 1.4), ("right", 10.0, 1.0))]
    table, differences = all_tables(summarise(rows))
    places = {label: cells[table.header.index("ribs' contrast → 1") - 1][1]
              for (label, _, _), cells in zip(table.lines, table.cells())}
    assert places == {"best": 2, "sharp": 0, "right": 1}
    column = differences.header.index("ribs' contrast, off 1 ↓") - 1
    assert [round(values[column].mean, 6) for _, _, values in differences.lines] == [0.3, -0.1]
    assert any("|value - 1|" in note for note in differences.notes)
    assert not any("|value - 1|" in note for note in table.notes)


def test_of_rows_that_differ_in_what_was_measured_alone_the_first_counts():
    first = [row("a", "x", 10.0, key="1", training="2 steps"), row("a", "x", 20.0, seed=1, key="2"),
             row("a", "y", 30.0, key="3"), row("a", "x", 40.0, key="4", delta=0.1), row("b", "x", None, key="5")]
    again = [row("a", "x", 99.0, key="6", training="3 steps"), row("b", "x", 99.0, key="7", warning="odd")]
    assert without_repeats(first + again) == first == without_repeats(first)


def test_each_condition_has_its_table_and_the_best_setting_stands_for_a_method():
    rows = [row("a", "x", 20.0 + n + views / 10, views=views, **{"method.iterations": n}) for views in (2, 8)
            for n in (1, 3, 2)] + [row("a", "y", 21.0, views=views) for views in (2, 8)]
    tables = {table.title: table for table in all_tables(summarise(rows))}
    best = tables["Methods, K = 8: each at its setting of highest mean PSNR"]
    assert [label for label, _, _ in best.lines] == ["x, iterations 3", "y"]
    assert len(tables["Methods, K = 2: all settings"].lines) == 4
    assert tables["PSNR (dB) ↑ against the number of views"].header == ["method", "K = 2", "K = 8"]
    assert tables["PSNR (dB) ↑ against the number of views"].lines[1] == ("x, iterations 3", True, [23.2, 23.8])


def test_settings_of_the_only_method_are_compared_case_by_case():
    rows = [row(case, "x", psnr + n, **{"method.iterations": n}) for n in (1, 3)
            for case, psnr in (("a", 20.0), ("b", 30.0))]
    *_, differences = all_tables(summarise(rows))
    assert differences.title == "Methods, K = 8, ideal: less x, iterations 3, case by case"
    assert "| x, iterations 1 |" in differences.markdown() and "-2.00 [-2.00, -2.00]" in differences.markdown()


def test_a_table_says_what_its_own_rows_rest_on_alone():
    rows = [row("a", "x", 20.0, views=2, protocol="x2ct", warning="odd", threads=1),
            row("a", "y", 21.0, views=2, protocol="x2ct", threads=1),
            row("a", "x", 22.0, views=8, protocol="sparc", threads=2), row("b", "y", 23.0, views=8, protocol="sparc")]
    of_x2ct, of_sparc = ["\n".join(table.notes) for table in all_tables(summarise(rows))]
    assert "Doubtful cases, by the column warning: x: a." in of_x2ct and "Doubtful" not in of_sparc
    assert "Protocol x2ct" in of_x2ct and "data range 2500 HU" in of_x2ct and "threads 1;" in of_x2ct
    assert "Protocol sparc" in of_sparc and "data range 2048 HU" in of_sparc and "threads 2;" in of_sparc
    assert "sparc" not in of_x2ct and "One case;" in of_x2ct
    assert "One case (not the same everywhere). HU" in of_sparc


def test_the_caption_tells_when_methods_had_other_cases_and_how_many():
    rows = [row(case, method, 20.0, views=views) for method, cases in (("x", "abc"), ("y", "ab")) for case in cases
            for views in (2, 8)]
    assert all(table.notes[0].startswith("Mean over 2 to 3 cases (not the same everywhere). HU")
               for table in all_tables(summarise(rows)) if "less" not in table.title)


def test_the_ceiling_of_dice_stands_beside_it_and_has_no_differences_between_methods():
    rows = [row(case, method, 20.0 + n, dice_lung=0.8 - n / 10, dice_lung_ct=0.97)
            for n, method in enumerate("xy") for case in "ab"]
    table, differences = all_tables(summarise(rows))
    assert "Dice lungs, of the CT itself" in table.header and "0.970" in table.markdown()
    assert "Dice lungs ↑" in differences.header and "Dice lungs, of the CT itself" not in differences.header


def test_every_table_says_how_long_its_rivals_have_learnt_and_that_is_no_setting():
    rows = [row(case, "rival", 20.0, training="K = 2, 790 steps") for case in "ab"] + [
        row(case, method, 21.0) for method in ("rival", "tv") for case in "cd"]
    entries = summarise(rows)
    assert [entry.method for entry in entries] == ["rival", "tv"] and not any(entry.settings for entry in entries)
    for table in all_tables(entries):
        assert "Trained rivals, as their files tell: rival K = 2, 790 steps." in table.notes
    assert "Trained rivals" not in all_tables(summarise(rows[2:]))[0].markdown()


def test_columns_that_stay_empty_are_kept_with_the_reason():
    entries = summarise([row("a", "x", 20.0), row("a", "y", 21.0)])
    (table,) = all_tables(entries, {"clip_t2i": "no weights were given"})
    assert "CLIP T2I (%) ↑" in table.header and "CLIP T2I (%): empty, since no weights were given." in table.notes
    assert "CLIP T2I" not in all_tables(entries)[0].markdown()


def test_a_score_of_some_cases_is_their_mean_and_says_of_how_many():
    rows = [row("a", "x", 20.0, dice_lung=0.9), row("b", "x", 22.0), row("a", "y", 21.0, dice_lung=0.7),
            row("b", "y", 23.0, dice_lung=0.8)]
    table = all_tables(summarise(rows))[0].markdown()
    line = next(line for line in table.splitlines() if line.startswith("| x"))
    assert "0.900" in line and "Dice lungs: of 1 of 2 cases (x)." in table
    assert "cases (y)" not in table


def test_a_case_of_which_a_seed_lacks_a_score_has_none_so_that_what_failed_does_not_count_as_good():
    rows = [row(case, method, 20.0, seed=seed, hd95_lung=5.0 + 40 * seed) for method in "xy" for case in "ab"
            for seed in (0, 1)]
    del rows[-1]["hd95_lung"]  # y loses the lungs of b where x has them 45 mm off
    x, y = summarise(rows)
    assert x.values["hd95_lung"] == {"a": 25.0, "b": 25.0} and y.values["hd95_lung"] == {"a": 25.0}
    table, differences = all_tables([x, y])
    assert "HD95 lungs (mm): of 1 of 2 cases (y)." in table.notes
    assert "HD95 lungs (mm): of 1 of 2 cases (y)." in differences.notes


def test_a_column_of_unlike_cases_ranks_nothing_and_the_others_do():
    def ranked() -> set[tuple[str, str]]:
        return {(table.title, name) for table in all_tables(summarise(rows))
                for name, *column in zip(table.header[1:], *table.cells()) if any(place for _, place in column)}

    rows = [row(case, method, 20.0 + n, views=views) for n, method in enumerate("xy") for case in "ab"
            for views in (2, 8)]
    whole = ranked()
    rows[-1]["ssim"] = None  # of one case, method and number of views
    assert ranked() == whole - {("Methods, K = 8", "SSIM ↑"), ("SSIM ↑ against the number of views", "K = 8")}
    assert len(whole - ranked()) == 2


def test_the_table_of_delta_has_the_misfit_beside_ssim():
    rows = [row("a", "x", 20.0 + d, delta=d) for d in (0.0, 0.8, 0.1)] + [row("a", "x", 21.0, delta=None)]
    table = next(t for t in all_tables(summarise(rows)) if "delta" in t.header)
    assert table.header[1:3] == ["SSIM ↑", "misfit ↓"]
    assert [label for label, _, _ in table.lines] == ["0", "0.1", "0.8"]
    assert [values[:2] for _, _, values in table.lines] == [[(20 + d) / 40, 1 / (20 + d)] for d in (0.0, 0.1, 0.8)]


def test_the_front_holds_what_nothing_beats():
    draw = random.Random(1)
    for _ in range(100):
        points = [(draw.randint(1, 6), draw.randint(1, 6)) for _ in range(draw.randint(1, 12))]
        kept = [points[i] for i in plots.front(points)]
        assert kept == sorted(set(kept)) and sorted(kept, key=lambda p: p[1]) == kept
        for cost, gain in points:
            beaten = any(c <= cost and g >= gain and (c, g) != (cost, gain) for c, g in points)
            assert ((cost, gain) in kept) != beaten


def test_every_plot_that_the_rows_allow_is_drawn(tmp_path):
    rows = [row("a", method, 20.0 + n, views=views, seconds_network=0.5, **more) for views in (1, 8)
            for n, (method, more) in enumerate([("x", {"delta": 0.0}), ("x", {"delta": 0.8}), ("y", {})])]
    files = plots.write_plots(tmp_path, summarise(rows))
    assert sorted(file.name for file in files) == sorted(p.name for p in tmp_path.iterdir())
    assert {file.stem for file in files} == {"pareto_K_1", "pareto_K_8", "stages_K_1", "stages_K_8", "views", "delta"}


def test_settings_of_a_method_differ_in_its_plots_in_line_and_filling():
    rows = [row("a", "x", 20.0 + views, views=views, geometry=f"{views}.yaml", delta=delta) for views in (2, 8)
            for delta in (0.0, 0.4, 0.8)]
    entries = summarise(rows)
    for draw, looked in ((plots._views, Line2D.get_linestyle), (plots._geometries, Line2D.get_fillstyle)):
        axes = Figure().subplots(1, 2)
        draw(axes, entries, plots.styles(entries))
        assert len({looked(line) for line in axes[0].lines}) == 3
        assert len({line.get_color() for line in axes[0].lines}) == 1


def test_no_two_of_many_methods_look_alike():
    style = plots.styles(summarise([row("a", f"method {n}", 20.0) for n in range(100)]))
    assert len({(look["color"], look["marker"]) for look in style.values()}) == 100


def test_plots_of_boxes_on_either_side_are_two(tmp_path):
    rows = [row("a", method, 20.0, centre=(x, 0.0, 20.0)) for x in (-60.0, 60.0) for method in "xy"]
    files = plots.write_plots(tmp_path, summarise(rows))
    assert len(set(files)) == len(files) == 4


def test_rows_that_are_all_refused_give_no_plot(tmp_path):
    rows = [row("a", "x", None, views=views, **more) for views in (1, 8) for more in ({"delta": 0.0}, {"delta": 0.8})]
    assert plots.write_plots(tmp_path, summarise(rows)) == [] == list(tmp_path.iterdir())


@pytest.mark.usefixtures("plots")
def test_dollars_in_the_name_of_a_method_are_no_formula_of_its_plots(tmp_path):
    names = ["a$\\frac$", "$x|[/b]"]
    rows = ablate(tmp_path, methods={name: {"of": "sirt", "method.iterations": 2} for name in names})
    assert {row["method"] for row in rows} == set(names) and list((tmp_path / "out").glob("*.png"))


def test_distances_are_told_of_their_own_condition_alone(tmp_path):
    boxes = [{}, {"simulation_voxels": 128}, {"simulation_voxels": None, "voxels": (16, 16, 8)}]
    entries = summarise(row("a", "x", 20.0, **box) for box in boxes)
    slices = {f"slices_{plane}": 16 for plane in PLANES}
    write_csv(tmp_path / FID, [{"method": "x"} | box | slices | {
        "fid_backbone": "b", "fid_normalisation": "n", "cases": 1} | dict.fromkeys(NAMES, float(n))
        for n, box in enumerate(boxes)])
    tables = distance_tables(tmp_path, entries)
    assert all("1 case with XY 16, YZ 16, ZX 16 slices" in table.notes[0] for table in tables)  # none tells seeds
    assert "made on 128^3 voxels." in tables[1].notes[-1]
    assert [[values[-1].mean for _, _, values in table.lines] for table in tables] == [[0.0], [1.0], [2.0]]


def test_seeds_of_a_case_are_no_cases_of_their_own_in_its_distances(tmp_path, monkeypatch):
    monkeypatch.setitem(DIMENSIONS, "squeezenet", 3)
    rows = [row(case, "x", 20.0, seed=seed, key=f"{case}{seed}") for case in ("p__a", "q__a") for seed in (0, 1)]
    for n, of in enumerate(rows):
        features_file(tmp_path, "").parent.mkdir(exist_ok=True)
        generator = torch.Generator().manual_seed(n)
        save_features(features_file(tmp_path, of["key"]),
                      {plane: torch.randn(2, 9, 3, generator=generator) for plane in PLANES})
    scoring = Scoring()
    scoring.network, scoring.fid = torch.nn.Identity(), FIDSettings(replicates=5)
    write_distances(tmp_path, entries := summarise(rows), scoring)
    (found,) = read_csv(tmp_path / FID)
    assert (found["cases"], found["patients"], found["seeds"]) == (2, 2, 2)
    assert (found["slices_xy"], found["truth_slices_xy"]) == (36, 18)
    (table,) = distance_tables(tmp_path, entries)
    assert "2 cases, 2 seeds each, with XY 36" in table.notes[0] and "of 2 patients;" in table.notes[1]
