"""Folders of CTs, CT-RATE's and others: what is found, with which reports, and who is held out."""

from __future__ import annotations

import csv
import warnings

import numpy as np
import pytest
import torch
from ct_files import AFFINE, save_ct
from dicom_files import write_ct_series

from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.cts.ct_rate import CTCases, find_cts, patient_of, split_by_patient
from phydict.datasets.cts.ct_rate_tables import read_reports
from phydict.datasets.cts.ct_series import find_series
from phydict.datasets.cts.reading import Calibration, load_ct
from phydict.datasets.cts.sources import find_sources
from phydict.grid import Grid

GRID = Grid.cube(32)


def write_csv(path, columns, *rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


REPORT_COLUMNS = ("VolumeName", "ClinicalInformation_EN", "Technique_EN", "Findings_EN", "Impressions_EN")
METADATA_COLUMNS = ("VolumeName", "RescaleIntercept", "RescaleSlope", "XYSpacing", "ZSpacing")


def ct_rate(root, chest, version="_fixed"):
    for name in ("1_a_1", "1_a_2", "1_b_1", "2_a_1", "10_a_1"):
        patient, scan, _ = name.split("_")
        save_ct(root / f"train{version}/train_{patient}/train_{patient}_{scan}/train_{name}.nii.gz", chest[:4, :4, :4])
    write_csv(root / "radiology_text_reports/train_reports.csv", REPORT_COLUMNS,
              ("train_1_a_1.nii.gz", "Not given.", "", "Nodule, 4 mm.", "Nodule."),
              ("train_2_a_1.nii.gz", "", "", "Not given.", ""))
    return root


def test_ct_rate_is_found_with_its_reports(tmp_path, chest):
    root = ct_rate(tmp_path, chest)
    cts = find_cts(root)
    assert [ct.id for ct in cts] == ["train_1_a_1", "train_1_a_2", "train_1_b_1", "train_2_a_1", "train_10_a_1"]
    nodule = "Findings: Nodule, 4 mm. Impression: Nodule."
    assert [ct.report for ct in cts] == [nodule, nodule, "", "", ""], "one report per scan"
    assert find_cts(root / "train_fixed" / "train_1")[0].report == nodule
    firsts = find_cts(root, first_reconstruction=True)
    assert [ct.id for ct in firsts] == ["train_1_a_1", "train_1_b_1", "train_2_a_1", "train_10_a_1"]
    (tmp_path / "no_chest.txt").write_text("train/train_2/train_2_a_1.nii.gz\n\n train_10_a_1.nii.gz\n")
    assert len(find_cts(root, exclude=tmp_path / "no_chest.txt")) == 3


@pytest.mark.parametrize("lines, left", [("x__a b", ["a b", "y__c"]), ("./x/a b.nii\nnobody", ["a b", "y__c"]),
                                         ("a b.nii\nelsewhere/y__c", ["x__a b"]), ("\n", ["a b", "x__a b", "y__c"])])
def test_a_list_leaves_out_the_cts_of_its_lines_and_no_others(tmp_path, chest, lines, left):
    for name in ("a b.nii", "x/a b.nii", "y/c.nii"):
        save_ct(tmp_path / "cts" / name, chest[:4, :4, :4])
    (tmp_path / "list.txt").write_text(lines)
    assert [ct.id for ct in find_cts(tmp_path / "cts", exclude=tmp_path / "list.txt")] == left


def test_a_list_to_exclude_of_other_cts_is_warned_of(tmp_path, chest):
    save_ct(tmp_path / "nifti" / "anna.nii", chest[:4, :4, :4])
    write_ct_series(tmp_path / "dicom" / "anna", np.zeros((8, 8, 4)), AFFINE)
    write_ct_series(tmp_path / "dicom" / "bob", np.zeros((8, 8, 4)), AFFINE)
    (tmp_path / "list.txt").write_text("anna, bob\n")
    for root in (tmp_path / "nifti", tmp_path / "dicom"):
        with pytest.warns(UserWarning, match="none of the 1 lines of .* CTs in .*first line is anna, bob.*CT is anna"):
            find_sources(root, exclude=tmp_path / "list.txt")
    (tmp_path / "list.txt").write_text("bob\n")
    assert [source.id for source in find_sources(tmp_path / "dicom", exclude=tmp_path / "list.txt")] == ["anna"]


@pytest.mark.parametrize("lines, left", [
    ("one\np1/a/s", ["two", "p1__b__s", "p2__s"]), ("p2/s\nnobody", ["one", "two", "p1__a__s", "p1__b__s"]),
    ("one.nii\ntwo.nii", ["p1__a__s", "p1__b__s", "p2__s"]),
    ("{root}/p1/b/s\n{root}/two.nii", ["one", "p1__a__s", "p2__s"])])
def test_a_list_to_exclude_is_one_of_nifti_files_and_of_series_beside_them(tmp_path, chest, lines, left):
    root = tmp_path / "cts"
    for name in ("one", "two"):
        save_ct(root / f"{name}.nii", chest[:4, :4, :4])
    for name in ("p1/a/s", "p1/b/s", "p2/s"):
        write_ct_series(root / name, np.zeros((8, 8, 4)), AFFINE)
    (tmp_path / "list.txt").write_text(lines.format(root=root))
    assert [source.id for source in find_sources(root, exclude=tmp_path / "list.txt")] == left


def test_v1_takes_hu_and_spacing_from_the_metadata(tmp_path, chest):
    root = tmp_path / "dataset"
    stored = (chest[::-1, ::-1] + 8192).astype(np.int16)
    save_ct(root / "valid/valid_1/valid_1_a/valid_1_a_1.nii.gz", stored, np.eye(4))
    with pytest.raises(ValueError, match="need CT-RATE's metadata table"):
        find_cts(root, fixed=False)
    table = write_csv(root / "metadata/validation_metadata.csv", METADATA_COLUMNS,
                      ("valid_1_a_1.nii.gz", "-8192", "1", "[6.0, 6.0]", "6.0"))
    case = CTCases(find_cts(root, fixed=False), None, GRID)[0]
    true = prepare_ct((chest.astype(np.float32), AFFINE), GRID)
    torch.testing.assert_close(case["volume"], true["volume"], atol=1e-3, rtol=0)
    write_csv(table, METADATA_COLUMNS, ("valid_2_a_1.nii.gz", "-8192", "1", "[6.0, 6.0]", "6.0"))
    with pytest.raises(ValueError, match="1 of 1 volumes are not in the metadata .* valid_1_a_1"):
        find_cts(root, fixed=False)
    write_csv(table, METADATA_COLUMNS, ("valid_1_a_1.nii.gz", "-8192", "1", "6", "6.0"))
    with pytest.raises(ValueError, match="metadata of valid_1_a_1.nii.gz .* cannot be read"):
        find_cts(root, fixed=False)


def test_where_both_versions_lie_side_by_side_fixed_chooses(tmp_path, chest):
    ct_rate(ct_rate(tmp_path, chest, ""), chest, "_fixed")
    assert all("train_fixed" in str(ct.path) for ct in find_cts(tmp_path))
    ids = [ct.id for ct in find_cts(tmp_path)]
    write_csv(tmp_path / "metadata/m.csv", METADATA_COLUMNS, *[(f"{i}.nii.gz", "0", "1", "[1, 1]", "1") for i in ids])
    assert not any("train_fixed" in str(ct.path) for ct in find_cts(tmp_path, fixed=False))


def test_a_flat_folder_and_a_single_file_need_no_reports(tmp_path, chest):
    for name in ("b.nii.gz", "a.NII.GZ".lower(), "p10.nii", "p9.nii", ".hidden.nii"):
        save_ct(tmp_path / name, chest[:4, :4, :4])
    (tmp_path / "notes.txt").write_text("x")
    assert [(ct.id, ct.report) for ct in find_cts(tmp_path)] == [("a", ""), ("b", ""), ("p9", ""), ("p10", "")]
    assert [ct.id for ct in find_cts(tmp_path / "p9.nii")] == ["p9"]


def test_files_of_the_same_name_in_patient_folders_are_told_apart(tmp_path, chest):
    for folder in ("x", "y"):
        save_ct(tmp_path / folder / "ct.nii", chest[:4, :4, :4])
    assert [ct.id for ct in find_cts(tmp_path)] == ["x__ct", "y__ct"] and patient_of("x__ct") == "x"
    save_ct(tmp_path / "y" / "ct.nii.gz", chest[:4, :4, :4])
    with pytest.raises(ValueError, match="would both become case y__ct"):
        find_cts(tmp_path)


@pytest.mark.parametrize("names, ids", [
    (("sub-01/ses-1/ct", "sub-01/ses-2/ct", "sub-02/ses-1/ct"),
     ["sub-01__ses-1__ct", "sub-01__ses-2__ct", "sub-02__ct"]),
    (("data/p1/ct", "data/p2/ct", "data/p2/other"), ["data__other", "data__p1__ct", "data__p2__ct"]),
    (("x/ct", "x/again/ct", "ct"), ["ct", "x__again__ct", "x__ct"])])
def test_where_names_clash_all_folders_are_in_the_id_and_the_patient_stays(tmp_path, chest, names, ids):
    for name in names:
        save_ct(tmp_path / f"{name}.nii.gz", chest[:4, :4, :4])
    found = {ct.id: ct.path.relative_to(tmp_path).parts for ct in find_cts(tmp_path)}
    assert [*found] == ids and all(patient_of(id) == parts[0].split(".")[0] for id, parts in found.items())


def test_links_to_one_ct_are_warned_of_unless_one_is_excluded(tmp_path, chest):
    save_ct(tmp_path / "cts" / "a.nii.gz", chest[:4, :4, :4])
    (tmp_path / "cts" / "b.nii.gz").symlink_to("a.nii.gz")
    with pytest.warns(UserWarning, match=r"1 of the 2 CTs in .* \(b is .*a.nii.gz, as a is\)"):
        assert len(find_cts(tmp_path / "cts")) == 2
    (tmp_path / "list.txt").write_text("b\n")
    assert len(find_cts(tmp_path / "cts", exclude=tmp_path / "list.txt")) == 1


def test_linked_folders_are_entered_once_and_hidden_ones_never(tmp_path, chest):
    root = tmp_path / "cts"
    for name in ("cts/ben/a.nii", "cts/.Trash-1000/old/a.nii", "elsewhere/a.nii"):
        save_ct(tmp_path / name, chest[:4, :4, :4])
    for name in ("cts/ben/s", "cts/.Trash-1000/s", "elsewhere/t"):
        write_ct_series(tmp_path / name, np.zeros((8, 8, 4)), AFFINE)
    links = {"anna": "../elsewhere", "ada": "ben", "again": "../elsewhere", "up": "..", "elsewhere/loop": "."}
    for name, place in links.items():
        (root / name if "/" not in name else tmp_path / name).symlink_to(place)
    assert [ct.id for ct in find_cts(root)] == ["again__a", "ben__a"]
    assert [series.folder for series in find_series(root)] == [root / "again" / "t", root / "ben" / "s"]


def test_folders_without_cts_are_explained(tmp_path):
    with pytest.raises(FileNotFoundError, match="it is empty"):
        find_cts(tmp_path)
    (tmp_path / "slice.dcm").write_text("x")
    with pytest.raises(FileNotFoundError, match="its 1 files are of other kinds.*DICOM series with data/prepare_cts"):
        find_cts(tmp_path)
    with pytest.raises(FileNotFoundError, match="is not a NIfTI file"):
        find_cts(tmp_path / "slice.dcm")
    with pytest.raises(FileNotFoundError, match="there is no folder or file"):
        find_cts(tmp_path / "absent")


def test_report_tables_are_checked(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no CSV table"):
        read_reports(tmp_path / "absent.csv")
    with pytest.raises(ValueError, match="lacks the columns Findings_EN, Impressions_EN"):
        read_reports(write_csv(tmp_path / "a.csv", ("VolumeName",)))


def test_a_table_of_reports_of_other_cts_is_refused_and_one_found_by_itself_warned_of(tmp_path, chest):
    save_ct(tmp_path / "cts" / "mine.nii.gz", chest[:4, :4, :4])
    table = write_csv(tmp_path / "others" / "train_reports.csv", REPORT_COLUMNS,
                      ("train_1_a_1.nii.gz", "", "", "Nodule, 4 mm.", "Nodule."))
    said = "none of the 1 reports in .* is of one of the 1 CTs in .*train_1_a_1, the first CT is mine"
    with pytest.raises(ValueError, match=said):
        find_cts(tmp_path / "cts", reports=table)
    table.parent.rename(tmp_path / "radiology_text_reports")
    with pytest.warns(UserWarning, match=said):
        assert find_cts(tmp_path / "cts")[0].report == ""


def test_a_table_without_a_row_is_refused_as_one_of_others_is(tmp_path, chest):
    save_ct(tmp_path / "cts" / "mine.nii.gz", chest[:4, :4, :4])
    empty = write_csv(tmp_path / "empty.csv", REPORT_COLUMNS)
    with pytest.raises(ValueError, match="none of the 0 reports in .*the first CT is mine"):
        find_cts(tmp_path / "cts", reports=empty)


def test_it_is_told_how_many_cts_have_a_report_where_not_all_have(tmp_path, chest, capsys):
    rows = [(f"{name}.nii.gz", "", "", "Nodule, 4 mm.", "Nodule.") for name in ("a", "B", "C_1")]
    table = write_csv(tmp_path / "reports.csv", REPORT_COLUMNS, *rows)
    for name in ("a", "b", "c"):
        save_ct(tmp_path / "cts" / f"{name}.nii.gz", chest[:4, :4, :4])
        write_ct_series(tmp_path / "dicom" / name, np.zeros((8, 8, 4)), AFFINE)
    for root in (tmp_path / "cts", tmp_path / "dicom"):
        assert sum(bool(source.report) for source in find_sources(root, reports=table)) == 1
        assert capsys.readouterr().err == "reports for 1 of 3 CTs; the first without is b\n"
    find_cts(tmp_path / "cts" / "a.nii.gz", reports=table)
    find_cts(tmp_path / "cts")
    assert not capsys.readouterr().err


def test_dicom_series_have_their_reports_by_name_and_a_table_of_others_is_refused(tmp_path):
    write_ct_series(tmp_path / "cts" / "anna", np.zeros((8, 8, 4)), AFFINE)
    rows = [("bob.nii.gz", "", "", "Nodule, 4 mm.", "Nodule."), ("anna.nii.gz", "", "", "Effusion.", "Effusion.")]
    found, = find_sources(tmp_path / "cts", reports=write_csv(tmp_path / "both.csv", REPORT_COLUMNS, *rows))
    assert "Effusion" in found.report and find_sources(tmp_path / "cts")[0].report == ""
    with pytest.raises(ValueError, match="none of the 1 reports in .*the first is anna"):
        find_sources(tmp_path / "cts", reports=write_csv(tmp_path / "others.csv", REPORT_COLUMNS, rows[0]))


def test_nifti_files_beside_dicom_series_are_not_lost_with_a_wrong_table(tmp_path, chest):
    save_ct(tmp_path / "cts" / "mine.nii.gz", chest[:4, :4, :4])
    write_ct_series(tmp_path / "cts" / "anna", np.zeros((8, 8, 4)), AFFINE)
    assert {source.id for source in find_sources(tmp_path / "cts")} == {"mine", "anna"}
    with pytest.raises(FileNotFoundError, match="there is no CSV table"):
        find_sources(tmp_path / "cts", reports=tmp_path / "absent.csv")


def test_a_patient_never_straddles_the_split():
    ids = [f"train_{p}_{s}_{r}" for p in range(20) for s in "ab" for r in (1, 2)] + ["x__1", "x__2", "LIDC-IDRI-0002"]
    for seed in range(20):
        train, held = split_by_patient(ids, 0.25, seed)
        assert sorted(train + held) == sorted(ids) and train and held
        assert not {patient_of(i) for i in train} & {patient_of(i) for i in held}
    assert split_by_patient(ids, 0.25, 3) == split_by_patient(ids, 0.25, 3) != split_by_patient(ids, 0.25, 4)
    assert split_by_patient(["a", "b"], 0.01)[1] and not split_by_patient(ids, 0)[1]
    with pytest.raises(ValueError, match="must lie in"):
        split_by_patient(ids, 1.5)


@pytest.mark.parametrize("fraction", [0.05, 0.3, 0.5])
@pytest.mark.parametrize("count", [2, 9, 50])
def test_a_patient_more_or_fewer_moves_at_most_one_other(count, fraction):
    patients = [f"p{n}" for n in range(count)]
    for seed in range(5):
        before = {*split_by_patient(patients, fraction, seed)[1]}
        for fewer in ([p for p in patients if p != left] for left in patients):
            now = {*split_by_patient(fewer, fraction, seed)[1]}
            assert len((before ^ now) & {*fewer}) <= 1


def test_metadata_of_voxels_that_no_ct_has_are_refused(tmp_path, chest):
    file = save_ct(tmp_path / "a.nii.gz", chest)
    for spacing in (1e30, 500.0, 1e-5):
        with pytest.raises(ValueError, match="a.nii.gz has voxels .*; correct it in the metadata table"):
            load_ct(file, Calibration(1, 0, (spacing,) * 3))


def written(path, *rows: str):
    path.write_text("\n".join(["VolumeName,Findings_EN,Impressions_EN", *rows, ""]), encoding="utf-8")
    return path


def test_a_comma_that_is_not_quoted_never_cuts_a_report_silently(tmp_path):
    table = written(tmp_path / "t.csv", "a.nii.gz,Normal.,Normal.", "b.nii.gz,Nodule, 4 mm.,Nodule.")
    with pytest.raises(ValueError, match=r"^row 3 of .*t.csv has more fields than its header: quote texts that hold"):
        read_reports(table)


@pytest.mark.parametrize("rows", [
    ('a,"Normal.,Normal.', "b,Nodule.,Nodule."), ('a,"Normal.,Normal.', 'b,"Nodule.","Nodule, 4 mm."'),
    ('a,Normal.,"Normal.', "b,Nodule.," + "x" * 140_000)])
def test_a_quote_that_is_not_closed_gives_no_patient_the_reports_of_others(tmp_path, rows):
    with pytest.raises(ValueError, match=r"^row 2 of .*t.csv cannot be read .*: close each quote") as caught:
        read_reports(written(tmp_path / "t.csv", *rows))
    assert "\n" not in str(caught.value)


def test_quoted_reports_keep_their_lines_commas_quotes_and_tabs(tmp_path):
    table = written(tmp_path / "t.csv", 'a,"Nodule, 4 mm;\n""ground\tglass"".",Nodule; benign.,', "b,x,y")
    assert read_reports(table) == {"a": 'Findings: Nodule, 4 mm; "ground glass". Impression: Nodule; benign.',
                                   "b": "Findings: x Impression: y"}


def test_a_blank_row_of_a_table_leaves_a_prepared_ct_its_own_report(tmp_path, chest, monkeypatch):
    save_ct(tmp_path / "cts" / "mine.nii.gz", chest[:4, :4, :4])
    monkeypatch.setattr("phydict.datasets.cts.ct_rate._own_report", lambda path: "Findings: Nodule.")
    for row, report in (("mine,,", "Nodule."), ("mine,Effusion.,", "Effusion.")):
        table = written(tmp_path / "t.csv", row, "other,Normal.,")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert find_cts(tmp_path / "cts", reports=table)[0].report == f"Findings: {report}"


def test_blank_texts_are_no_reports_and_a_table_of_blank_ones_alone_is_warned_of(tmp_path, chest, capsys):
    for name in ("a", "b", "c"):
        save_ct(tmp_path / "cts" / f"{name}.nii.gz", chest[:4, :4, :4])
        write_ct_series(tmp_path / "dicom" / name, np.zeros((8, 8, 4)), AFFINE)
    some = written(tmp_path / "some.csv", "a,Nodule.,", "b,,Not given.", "c,nan,")
    none = written(tmp_path / "none.csv", "a,,", "other,Nodule.,")
    for root in (tmp_path / "cts", tmp_path / "dicom"):
        find_sources(root, reports=some)
        assert capsys.readouterr().err == "reports for 1 of 3 CTs; the first without is b\n"
        with pytest.warns(UserWarning, match=r"none.csv has no report of any of the 3 CTs, the first of which is a"):
            find_sources(root, reports=none)
