"""The page of results: what it holds is what lies on disk, and other people's text stays text."""

import base64
import gzip
import json
import re
import shutil
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch

from page.made import TURNED, finish, random_hu
from phydict.cli.infer import main
from phydict.evaluation import Table, write_csv
from phydict.evaluation.backbones import DIMENSIONS
from phydict.evaluation.fid import save_features
from phydict.evaluation.metrics import MEASURES
from phydict.evaluation.planes import PLANES
from phydict.grid import Grid
from phydict.inference import ReconstructionData
from phydict.inference.page import results_page
from phydict.inference.results import FEATURES, RECORD, CaseResults
from phydict.inference.settings import Orbit
from phydict.page import CASE_FILES, PAGE, Contents, write_case_files, write_page
from phydict.page.case_files import NO_VALUE
from phydict.xray import Ideal, Polychromatic

HOSTILE = "</script><script>alert(1)</script> \"'&# %é😀<!--CONTENT-->"


def view(folder) -> dict:
    """What the script of a case hands to the page."""
    return json.loads((folder / "view.js").read_text().removeprefix("phydictView(").rstrip().removesuffix(");"))


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(gzip.decompress(base64.b64decode(text)), kind)


def volume_in(folder) -> np.ndarray:
    """The reconstruction as the page has it."""
    held = view(folder)
    return unpacked(held["volumes"]["reconstruction"], "<i2").reshape(held["shape"], order="F")


def content(page) -> dict:
    """What the document holds for its script."""
    text = page.read_text()
    return json.loads(re.search(r'id="content">(.*)</script>\n<script>', text).group(1))


def test_the_pages_volume_is_the_niftis_rounded_and_turned_to_ras(tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    image = nibabel.as_closest_canonical(nibabel.load(folder / "volume.nii.gz"))
    held = view(folder)
    assert (volume_in(folder) == np.rint(np.asarray(image.dataobj))).all()
    assert np.allclose(np.array(held["affine"]), image.affine[:3], atol=1e-5)
    assert np.allclose(np.vstack([held["inverse"], [0, 0, 0, 1]]), np.linalg.inv(image.affine), atol=1e-5)


def test_voxels_that_are_not_finite_and_beyond_int16_are_marked_and_clipped(tmp_path):
    hu = random_hu(0)
    hu[0, 0, 0], hu[1, 0, 0], hu[2, 0, 0] = torch.nan, torch.inf, 1e6
    write_case_files(tmp_path, TURNED, {"reconstruction": hu})
    volume = volume_in(tmp_path)
    assert (volume == NO_VALUE).sum() == 2 and (volume == 32767).sum() == 1


@pytest.mark.parametrize("shape, shown", [((2, 40, 30), (2, 40, 30)), ((1, 600, 301), (1, 200, 100)),
                                          ((2, 1, 600), (2, 1, 200)), ((2, 600, 1), (2, 200, 1)),
                                          ((2, 2, 600), (2, 1, 200))])
def test_the_pages_xrays_are_the_measured_ones_to_half_a_step(tmp_path, shape, shown):
    y = torch.from_numpy(np.random.default_rng(0).uniform(-1, 8, shape))
    write_case_files(tmp_path, TURNED, {"reconstruction": random_hu(0)}, y, y + 1, pixel=2.0)
    held = view(tmp_path)["X-rays"]
    codes = unpacked(held["measured"], "<u2").reshape(held["shape"])
    rows, columns = shape[1] // shown[1], shape[2] // shown[2]
    wanted = y.numpy()[:, :, :shown[2] * columns].reshape(shape[0], shown[1], rows, shown[2], columns).mean((2, 4))
    assert held["pixel"] == 2 * rows / columns
    assert codes.shape == shown and abs(held["low"] + codes * held["step"] - wanted).max() <= 0.51 * held["step"]
    assert abs(unpacked(held["rendered"], "<u2").astype(float) - codes.ravel() - 1 / held["step"]).max() <= 1


def test_hostile_text_is_data_and_nothing_else(tmp_path):
    name = HOSTILE.replace("/", "∕")
    finish(tmp_path, name, "sirt", report=HOSTILE, warnings=[HOSTILE], scores=None)
    page = results_page(tmp_path)
    [case] = content(page)["cases"]
    assert case["record"]["report"] == HOSTILE == case["record"]["warnings"][0] and case["record"]["case"] == name
    before = page.read_text().count("<script")
    write_page(tmp_path, Contents(HOSTILE, [Table(HOSTILE, [HOSTILE], [], [(HOSTILE, True, [])], [HOSTILE])]))
    assert page.read_text().count("<script") == before and content(page)["title"] == HOSTILE


def test_of_unequal_numbers_of_views_none_is_the_better(tmp_path):
    for method, views, psnr in (("sirt", 2, 9.0), ("tv", 8, 21.0), ("fdk", 8, 10.0)):
        finish(tmp_path, "anna", method, views=views, scores={"psnr": psnr})
    places = {c["record"]["method"]: c["places"]["psnr"] for c in content(results_page(tmp_path))["cases"]}
    assert places == {"sirt": 0, "tv": 1, "fdk": 2}


def of_test(**data) -> dict:
    """The settings of a test whose X-rays are of these settings."""
    return {"seed": 0, "data": {"with_report": True} | ReconstructionData(cts="phantom", **data).settings("test")}


FINE = Grid((12, 18, 14), affine=TURNED.affine @ np.diag([0.5, 0.5, 0.5, 1.0]))


@pytest.mark.parametrize("title, views, settings, grid", [
    ("K = 8", 8, {"orbit": Orbit(8)}, TURNED), ("noise 0.02", 3, {"simulator": Ideal(noise=0.02)}, TURNED),
    ("Polychromatic", 3, {"simulator": Polychromatic()}, TURNED),
    ("geometry biplanar", 3, {"geometry": "biplanar"}, TURNED),
    ("simulation voxels 128", 3, {"simulation_voxels": 128}, TURNED),
    ("grid 12x18x14 of 1.5 x 2 x 2.5 mm", 3, {}, FINE)])
def test_what_is_of_unlike_xrays_or_voxels_is_neither_ranked_nor_paired_together(
        title, views, settings, grid, tmp_path, monkeypatch):
    monkeypatch.setitem(DIMENSIONS, "squeezenet", 3)
    for n, method in enumerate(("fdk", "sirt", "tv")):
        of = (views, settings, grid) if method == "tv" else (3, {}, TURNED)
        folder = finish(tmp_path, "anna", method, grid=of[2], views=of[0], scores={"psnr": 20.0 + n},
                        settings=of_test(**of[1]) | {"fid_backbone": "squeezenet"})
        generator = torch.Generator().manual_seed(n)
        save_features(folder / FEATURES, {plane: torch.randn(2, 9, 3, generator=generator) for plane in PLANES})
    held = content(results_page(tmp_path))
    assert [case["places"]["psnr"] for case in held["cases"]] == [2, 1, 0]
    for kind in ("Scores by method", "Frechet distance"):
        first, second = (table for table in held["tables"] if table["title"].startswith(kind))
        assert [row[0]["text"] for row in first["rows"]] == ["fdk", "sirt"]
        assert [row[0]["text"] for row in second["rows"]] == ["tv"]
        assert title in second["title"] and title not in first["title"] and first["title"] != second["title"]


def test_what_is_no_matter_of_xrays_and_voxels_keeps_cases_in_one_table_as_a_report(tmp_path):
    for n, (method, change) in enumerate((("fdk", {}), ("sirt", {"with_report": False}), ("tv", {"photons": None}))):
        settings = of_test()
        settings["data"] |= {name: value for name, value in change.items() if name == "with_report"}
        settings["data"]["simulator"] |= {name: value for name, value in change.items() if name == "photons"}
        finish(tmp_path, "anna", method, settings=settings, scores={"psnr": 20.0 + n})
    held = content(results_page(tmp_path))
    assert [table["title"] for table in held["tables"]] == ["Scores by method"]
    assert [case["places"]["psnr"] for case in held["cases"]] == [0, 2, 1]


@pytest.mark.parametrize("of", [{"settings": of_test() | {"seed": 1}}, {"source": "crc32 2"}], ids=["seed", "data"])
def test_cases_of_one_name_but_other_data_or_seeds_are_neither_ranked_nor_paired(tmp_path, monkeypatch, of):
    monkeypatch.setitem(DIMENSIONS, "squeezenet", 3)
    for n, (method, change) in enumerate((("fdk", {}), ("sirt", {}), ("tv", of))):
        more = {"settings": of_test()} | change
        more["settings"] |= {"fid_backbone": "squeezenet"}
        folder = finish(tmp_path, "anna", method, scores={"psnr": 20.0 + n}, **more)
        generator = torch.Generator().manual_seed(n)
        save_features(folder / FEATURES, {plane: torch.randn(2, 9, 3, generator=generator) for plane in PLANES})
    held = content(results_page(tmp_path))
    assert [case["places"]["psnr"] for case in held["cases"]] == [2, 1, 0]
    assert {table["title"] for table in held["tables"]} == {"Scores by method", "Frechet distance of slices (FID)"}
    for table in held["tables"]:
        assert not any(cell.get("place") for row in table["rows"] for cell in row)
        assert "under one name, and so neither ranked nor paired: anna, anna (2)." in " ".join(table["notes"])
    assert all(case["record"]["case"] == "anna" for case in held["cases"])


def test_seconds_of_first_calls_are_not_ranked(tmp_path):
    for method, seconds in (("sirt", 1.0), ("tv", 9.0)):
        finish(tmp_path, "anna", method, seconds={"sample": seconds})
    held = content(results_page(tmp_path))
    assert [case["places"]["seconds"] for case in held["cases"]] == [0, 0]
    (table,) = held["tables"]
    assert all(row[table["header"].index("time (s)")]["place"] == 0 for row in table["rows"])
    assert any(note.startswith("Seconds: first calls included") for note in table["notes"])


def test_the_best_of_each_case_is_marked_among_the_methods(tmp_path):
    for case, better in (("anna", "sirt"), ("bert", "tv")):
        for method in ("sirt", "tv"):
            finish(tmp_path, case, method, scores={"psnr": 20.0 + (method == better)})
    places = {(c["record"]["case"], c["record"]["method"]): c["places"]["psnr"]
              for c in content(results_page(tmp_path))["cases"]}
    assert places == {("anna", "sirt"): 1, ("anna", "tv"): 2, ("bert", "sirt"): 2, ("bert", "tv"): 1}


def test_what_is_not_a_number_leaves_the_page_readable(tmp_path):
    finish(tmp_path, "anna", "sirt", misfit=float("nan"), misfit_per_view=[float("nan")] * 3,
           scores={"psnr": float("inf")})
    [case] = content(results_page(tmp_path))["cases"]
    assert case["record"]["misfit"] is None and case["scores"]["psnr"] is None


def test_the_page_is_made_anew_of_what_older_runs_left(tmp_path, capsys):
    folder = finish(tmp_path, "anna", "sirt", with_page=False)
    main(["page", str(tmp_path)])
    told = capsys.readouterr()
    assert str(tmp_path / PAGE) in told.out and all((folder / name).is_file() for name in CASE_FILES)
    assert told.err.splitlines() == [f"page: 1 case to prepare, results in {tmp_path}",
                                     "sirt/anna: prepared (1 of 1)"]
    image = nibabel.as_closest_canonical(nibabel.load(folder / "volume.nii.gz"))
    assert (volume_in(folder) == np.rint(image.get_fdata())).all()
    results = CaseResults(folder.parent, overwrite=True)  # the case is still this project's alone
    assert results.unfinished({"anna": "crc32 1"}, {"seed": 0}) == ["anna"]


@pytest.mark.filterwarnings("ignore:.* is left out of the page")
def test_many_older_cases_are_told_one_by_one_to_people_and_machines_and_those_that_are_whole_are_not(tmp_path, capsys):
    for case in ("anna", "bert", "carl", "dora"):
        finish(tmp_path, case, "sirt", with_page=case == "dora")
    (tmp_path / "sirt" / "bert" / "volume.nii.gz").write_bytes(b"no volume")
    main(["page", str(tmp_path), "--json_lines"])
    begin, *told = map(json.loads, capsys.readouterr().err.splitlines())
    assert (begin["event"], begin["cases"], begin["out"]) == ("begin", 3, str(tmp_path))
    assert [(e["case"], e["summary"], e["done"]) for e in told if e["event"] == "case"] == [
        ("sirt/anna", "prepared", 1), ("sirt/bert", "left out", 2), ("sirt/carl", "prepared", 3)]
    (tmp_path / "sirt" / "anna" / "view.js").unlink()
    shutil.rmtree(tmp_path / "sirt" / "bert")
    main(["page", str(tmp_path), "--quiet"])
    assert capsys.readouterr().err == ""
    main(["page", str(tmp_path)])
    assert capsys.readouterr().err == ""


def test_a_missing_thumbnail_is_made_and_what_else_the_page_shows_stays(tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    (folder / "thumbnail.png").unlink()
    shown = (folder / "view.js").read_bytes()
    results_page(tmp_path)
    assert (folder / "thumbnail.png").is_file() and (folder / "view.js").read_bytes() == shown


def test_the_page_of_one_method_is_that_of_its_folder(tmp_path):
    finish(tmp_path, "anna", "sirt"), finish(tmp_path, "anna", "tv")
    assert [case["folder"] for case in content(results_page(tmp_path / "sirt"))["cases"]] == ["anna"]
    assert [case["folder"] for case in content(results_page(tmp_path))["cases"]] == ["sirt/anna", "tv/anna"]


def test_cases_that_are_being_written_or_set_aside_are_no_results_and_a_name_that_begins_with_a_dot_is_one(tmp_path):
    for case in ("..anna", ".12-host-anna.partial", ".anna.set-aside-by-phydict"):
        finish(tmp_path, case, "sirt")
    finish(tmp_path, "anna", ".hidden")
    assert [case["folder"] for case in content(results_page(tmp_path))["cases"]] == ["sirt/..anna"]


def test_a_line_of_several_settings_is_named_beneath_the_means_and_one_of_several_seeds_is_not(tmp_path):
    for method, change in (("sirt", {"noise": 0.1}), ("tv", {"seed": 1})):
        finish(tmp_path, "anna", method), finish(tmp_path, "bert", method, settings={"seed": 0} | change)
    assert "Cases of several settings, as their records tell, in one line: sirt." in results_page(tmp_path).read_text()


def test_a_method_s_folder_of_another_name_is_a_line_and_cases_of_its_own(tmp_path):
    finish(tmp_path, "anna", "sirt")
    shutil.copytree(tmp_path / "sirt", tmp_path / "sirt_old")
    held = content(results_page(tmp_path))
    assert [row[0]["text"] for row in held["tables"][0]["rows"]] == ["sirt", "sirt (sirt_old)"]
    assert {case["record"]["method"]: case["folder"] for case in held["cases"]} == {
        "sirt": "sirt/anna", "sirt (sirt_old)": "sirt_old/anna"}


def test_a_case_s_folder_of_another_name_is_a_case_of_its_own(tmp_path):
    shutil.copytree(finish(tmp_path, "anna", "sirt"), tmp_path / "sirt" / "anna_old")
    held = content(results_page(tmp_path))
    assert {case["record"]["case"]: case["folder"] for case in held["cases"]} == {
        "anna": "sirt/anna", "anna (anna_old)": "sirt/anna_old"}
    assert "n = 2 cases" in " ".join(held["tables"][0]["notes"])


def test_cases_of_several_protocols_have_a_table_each_of_its_own_range(tmp_path):
    for method, data in (("sirt", {}), ("tv", {"protocol": "x2ct"}), ("fdk", {"protocol": "x2ct"})):
        finish(tmp_path, "anna", method, settings={"seed": 0, "data": data})
    tables = content(results_page(tmp_path))["tables"]
    assert [[row[0]["text"] for row in table["rows"]] for table in tables] == [["fdk", "tv"], ["sirt"]]
    for table, ends in zip(tables, ("[-1000, 1500]", "[-1000, 1000]")):
        assert ends in " ".join([table["title"], *table["notes"]])


def test_of_other_data_or_protocols_none_is_the_better_and_what_is_of_a_protocol_is_named(tmp_path):
    finish(tmp_path, "anna", "sirt", scores={"psnr": 20.0}, source="crc32 1")
    finish(tmp_path, "anna", "tv", scores={"psnr": 21.0}, source="crc32 2")
    finish(tmp_path, "anna", "fdk", scores={"psnr": 22.0}, settings={"seed": 0, "data": {"protocol": "x2ct"}})
    held = content(results_page(tmp_path))
    assert [case["places"]["psnr"] for case in held["cases"]] == [0, 0, 0]
    assert [point["series"] for point in held["points"]] == [
        "fdk, protocol x2ct", "sirt, no protocol", "tv, no protocol"]
    assert [table["title"].removeprefix("Scores by method") for table in held["tables"]] == [
        ", protocol x2ct", ", no protocol"]


def test_frechet_distances_of_other_weights_and_of_each_protocol_have_a_table_each(tmp_path, monkeypatch):
    monkeypatch.setitem(DIMENSIONS, "squeezenet", 3)
    others = {"cgls": {"data": {"protocol": "x2ct"}}, "tv": {"fid_weights_crc32": 2}}
    for n, method in enumerate(("cgls", "fdk", "sirt", "tv")):
        settings = {"seed": 0, "data": {}, "fid_backbone": "squeezenet", "fid_weights_crc32": 1}
        settings |= others.get(method, {})
        generator = torch.Generator().manual_seed(n)
        save_features(finish(tmp_path, "anna", method, settings=settings) / FEATURES,
                      {plane: torch.randn(2, 9, 3, generator=generator) for plane in PLANES})
    distances = [table for table in content(results_page(tmp_path))["tables"] if "(FID)" in table["title"]]
    assert [[row[0]["text"] for row in table["rows"]] for table in distances] == [["cgls"], ["fdk", "sirt"], ["tv"]]


def test_a_damaged_case_is_left_out_with_a_word(tmp_path):
    finish(tmp_path, "anna", "sirt")
    (finish(tmp_path, "bert", "sirt") / RECORD).write_text("{")
    (finish(tmp_path, "carl", "sirt", with_page=False) / "volume.nii.gz").write_bytes(b"no volume")
    with pytest.warns(UserWarning, match="is left out of the page, since its files are damaged") as said:
        page = results_page(tmp_path)
    assert [case["record"]["case"] for case in content(page)["cases"]] == ["anna"] and len(said) == 2


def test_a_folder_without_results_is_refused_in_one_sentence(tmp_path, capsys):
    for given in (tmp_path, tmp_path / "none", tmp_path / RECORD):
        with pytest.raises(SystemExit) as stopped:
            main(["page", str(given)])
        said = capsys.readouterr().err
        assert stopped.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
        assert "predict, test or ablate wrote to" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no folder that nobody may write to")
def test_a_folder_that_cannot_be_written_to_is_refused_in_one_sentence(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["page", "/proc"])
    assert "/proc cannot be written to" in (said := capsys.readouterr().err) and "such as a copy" in said


def test_a_page_of_someone_elses_stays(tmp_path):
    finish(tmp_path, "anna", "sirt")
    (tmp_path / PAGE).write_text("<html>mine</html>")
    with pytest.raises(ValueError, match="is no page of results by phydict, and is not replaced"):
        results_page(tmp_path)
    assert (tmp_path / PAGE).read_text() == "<html>mine</html>"


def test_a_comparisons_page_has_the_rows_that_count_its_tables_and_its_plots(tmp_path, capsys):
    rows = [{"case": case, "method": method, "views": views, "seed": 0, "simulator": "ideal", "status": "ok",
             "psnr": 20.0 + views, "ssim": 0.5, "mae_hu": 50.0, "misfit": 0.1, "seconds": 2.0, "network_calls": 0,
             "key": f"{case}{method}{views}"}
            for case in ("anna", "bert") for method in ("sirt", "tv") for views in (2, 8)]
    rows[0] |= {"status": "refused", "error": "why", "psnr": None}
    write_csv(tmp_path / "results.csv", rows)
    (tmp_path / "pareto.png").touch()
    main(["page", str(tmp_path)])
    held = content(tmp_path / PAGE)
    assert len({(case["record"]["method"], case["record"]["case"]) for case in held["cases"]}) == len(rows) - 1
    assert held["plots"] == [{"name": "pareto.png", "url": "pareto.png"}] and len(held["points"]) == 4
    assert held["tables"] and held["error"] == MEASURES["mae_hu"].label
    assert any("why" in note for table in held["tables"] for note in table["notes"])
