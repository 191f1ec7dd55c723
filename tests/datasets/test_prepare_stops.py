"""Preparing CTs: a stopped run resumes, nothing of others is replaced, nothing is half written."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import runpy
import shutil
import signal
from pathlib import Path

import nibabel
import numpy as np
import pytest
from ct_files import AFFINE, save_ct
from dicom_files import write_ct_series
from processes import FORKS, Python

from phydict.datasets.cts import cache, preparation
from phydict.datasets.cts.ct_rate import CTCases, find_cts
from phydict.datasets.cts.ct_rate_tables import read_calibrations, read_reports
from phydict.datasets.cts.preparation import SUMMARY, prepare_folder
from phydict.datasets.cts.prepared import RECORD
from phydict.datasets.cts.reading import Calibration
from phydict.datasets.cts.sources import Source
from phydict.datasets.cts.spaces import Settings
from phydict.grid import Grid

SMALL = Settings(voxels=32)


ROOT = Path(__file__).parents[2]


def contents(folder):
    """Every file below a folder with its bytes, gzip's own time stamps left out."""
    return {str(p.relative_to(folder)): nibabel.load(p).get_fdata().tobytes() if p.name.endswith(".gz")
            else p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name != SUMMARY}


def test_two_workers_give_what_one_gives(tmp_path, thorax, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_context", {"spawn": FORKS}.get)  # whose workers need not import anew
    for n in range(2):
        save_ct(tmp_path / f"in/{n}.nii.gz", thorax + np.int16(10 * n))
    save_ct(tmp_path / "in/short.nii.gz", thorax[:, :, :3])
    one, two = (prepare_folder(tmp_path / "in", tmp_path / str(workers), SMALL, workers) for workers in (1, 2))
    assert one == two and [row["status"] for row in one] == ["prepared"] * 2 + ["rejected"]
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert (tmp_path / "1" / SUMMARY).read_bytes() == (tmp_path / "2" / SUMMARY).read_bytes()


@pytest.mark.slow
def test_ctrl_c_while_workers_begin_is_left_to_the_command(tmp_path, thorax):
    for n in range(2):
        save_ct(tmp_path / f"in/{n}.nii", thorax)
    code = ("import os, signal, sys, time\nfrom phydict.datasets.cts import preparation as p\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\nos.setpgrp()\n"
            "class Pool(p.ProcessPoolExecutor):\n"
            "    def submit(self, work, source, *args):\n"
            "        submitted = super().submit(work, source, *args)\n"
            "        if source.id == '1':\n"
            "            time.sleep(0.5)\n"
            "            os.killpg(0, signal.SIGINT)\n"
            "        return submitted\n"
            "p.ProcessPoolExecutor = Pool\ntry:\n"
            f"    p.prepare_folder({str(tmp_path / 'in')!r}, {str(tmp_path / 'out')!r}, p.Settings(voxels=32), 2)\n"
            "except KeyboardInterrupt:\n    sys.exit(130)")
    stopped = Python(code)
    assert stopped.wait() == 130 and "Traceback" not in stopped.err and "2 cases to prepare" in stopped.err


def test_a_killed_run_goes_on_where_it_was(tmp_path, thorax):
    for n in range(2):
        save_ct(tmp_path / f"in/{n}.nii.gz", thorax + np.int16(10 * n))
    code = ("import os, signal\nfrom phydict.datasets.cts import preparation as p\nwrite = p.write_prepared\n"
            "def writes(folder, grid, images, record):\n"
            "    write(folder, grid, images, record)\n"
            "    if record['id'] == '1': os.kill(os.getpid(), signal.SIGKILL)\n"
            f"p.write_prepared = writes\np.prepare_folder({str(tmp_path / 'in')!r}, {str(tmp_path / 'out')!r}, "
            "p.Settings(voxels=32))")
    killed = Python(code)
    assert killed.wait() == -signal.SIGKILL, killed.err
    assert (tmp_path / "out/0" / RECORD).is_file() and not (tmp_path / "out/1").exists()
    assert any(p.name.endswith(".partial") for p in (tmp_path / "out").iterdir())
    assert [ct.id for ct in find_cts(tmp_path / "out")] == ["0"], "what is half-written is no case"
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out/0").iterdir()}
    rows = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out/0").iterdir()} == before
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["0", "1", SUMMARY]
    assert rows == prepare_folder(tmp_path / "in", tmp_path / "whole", SMALL)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_changed_input_is_prepared_again_and_other_settings_are_refused(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    save_ct(tmp_path / "in/a.nii", thorax[:, :, 1:] + np.int16(100))
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert nibabel.load(tmp_path / "out/a/ct.nii.gz").get_fdata().max() > 900
    with pytest.raises(ValueError, match="was prepared with other settings"):
        prepare_folder(tmp_path / "in", tmp_path / "out", Settings(voxels=16))
    (tmp_path / "out/a" / RECORD).write_text("{")
    with pytest.raises(ValueError, match="case.json cannot be read .* prepare that CT again"):
        find_cts(tmp_path / "out")


def test_a_case_goes_when_its_ct_is_rejected_and_is_named_when_its_ct_is_gone(tmp_path, thorax):
    for name in ("a", "b", "c"):
        save_ct(tmp_path / f"in/{name}.nii", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    save_ct(tmp_path / "in/a.nii", thorax[:, :, :2])
    (tmp_path / "in/b.nii").unlink()
    with pytest.warns(UserWarning, match="out holds 1 case of no CT that is taken from .*: remove b if"):
        rows = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert [(row["id"], row["status"]) for row in rows] == [("a", "rejected"), ("c", "prepared")]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["b", "c", SUMMARY]


STORED = Calibration(1.0, 0.0, (6.0, 6.0, 6.0)).affine()
REPORTS = "VolumeName,Findings_EN,Impressions_EN\na.nii,{},\n"
METADATA = 'VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\na.nii,1,{},"[6, 6]",6\n'


def other_voxels(at, hu):
    save_ct(at / "in/a.nii", hu + np.int16(100), STORED)


def other_report(at, _hu):
    (at / "reports.csv").write_text(REPORTS.format("Nodule."))


def other_calibration(at, _hu):
    (at / "metadata.csv").write_text(METADATA.format(-10))


def masks_exchanged(at, _hu):
    vessels, airway, aside = (at / f"in/a_totalsegmentator/{name}" for name in ("lung_vessels.nii.gz", "trachea.nii.gz",
                                                                                "aside"))
    vessels.rename(aside)
    airway.rename(vessels)
    aside.rename(airway)


def one_other_slice(at, _hu):
    file = sorted((at / "in/s").iterdir())[20]
    file.write_bytes(file.read_bytes()[:-400] + bytes(400))


def record_of_an_older_version(at, _hu):
    file = at / "out/a" / RECORD
    record = json.loads(file.read_text())
    record["fingerprint"] = {name: record["fingerprint"][name] for name in ("files", "bytes")}
    file.write_text(json.dumps(record))


def test_a_case_of_another_input_of_the_same_size_is_prepared_anew_and_told_and_no_other(tmp_path, thorax, capsys):
    save_ct(tmp_path / "in/a.nii", thorax, STORED)
    for name, mask in (("lung_vessels", thorax > 500), ("trachea", thorax < -845)):
        save_ct(tmp_path / f"in/a_totalsegmentator/{name}.nii.gz", mask.astype(np.uint8), STORED)
    write_ct_series(tmp_path / "in/s", thorax, AFFINE)
    (tmp_path / "reports.csv").write_text(REPORTS.format("No nodule."))
    (tmp_path / "metadata.csv").write_text(METADATA.format(0))

    def prepared(out):
        rows = prepare_folder(tmp_path / "in", tmp_path / out, SMALL, fixed=False, reports=tmp_path / "reports.csv",
                              metadata=tmp_path / "metadata.csv")
        assert [(row["id"], row["status"]) for row in rows] == [("a", "prepared"), ("s", "prepared")]
        return {name: (tmp_path / out / name).stat().st_ino for name in "as"}, capsys.readouterr().err

    before, said = prepared("out")
    assert "prepared again" not in said
    for change in (other_voxels, other_report, other_calibration, masks_exchanged, one_other_slice,
                   record_of_an_older_version):
        change(tmp_path, thorax)
        changed, other = "sa" if change is one_other_slice else "as"
        after, said = prepared("out")
        assert after[changed] != before[changed] and after[other] == before[other], change
        assert f"1 case in {tmp_path / 'out'} will be prepared again and replaced ({changed}): a CT, segment" in said
        before = after
    after, said = prepared("out")
    assert after == before and "prepared again" not in said
    prepared("whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_ct_that_changes_while_it_is_prepared_is_prepared_again(tmp_path, thorax, monkeypatch):
    save_ct(tmp_path / "in/a.nii", thorax)
    load = Source.load
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(Source, "load", lambda self: (load(self), save_ct(self.ct.path, thorax + np.int16(100)))[0])
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    for out in ("out", "whole"):
        prepare_folder(tmp_path / "in", tmp_path / out, SMALL)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def notes_inside(case):
    (case / "notes.txt").write_text("mine")


def strangers(case):
    shutil.rmtree(case)
    case.mkdir()
    notes_inside(case)


def linked(case):
    case.rename(case.with_name("elsewhere"))
    case.symlink_to(case.with_name("elsewhere"))


def dangling(case):
    shutil.rmtree(case)
    case.symlink_to(case.with_name("nowhere"))


@pytest.mark.parametrize("when", ["at the start", "when a case takes its place"])
@pytest.mark.parametrize("change", [notes_inside, strangers, linked, dangling])
def test_what_no_preparation_wrote_is_never_replaced(tmp_path, thorax, monkeypatch, change, when):
    save_ct(tmp_path / "in/a.nii", thorax)
    prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    save_ct(tmp_path / "in/a.nii", thorax[:, :, 1:])  # so that it is prepared again
    case = tmp_path / "out/a"
    if when == "at the start":
        change(case)
    else:
        write = preparation.write_prepared
        monkeypatch.setattr(preparation, "write_prepared", lambda *given: (write(*given), change(case)))
    with pytest.raises(ValueError, match="out/a .* is not replaced: move .* away, or give another output folder"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert case.is_symlink() == (change in (linked, dangling)) and case.exists() == (change is not dangling)
    assert change in (linked, dangling) or (case / "notes.txt").read_text() == "mine"
    assert change is not linked or (case / RECORD).is_file()
    assert not any(path.name.startswith(".") for path in (tmp_path / "out").iterdir())


def test_a_summary_of_someone_elses_is_never_replaced(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii", thorax)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / SUMMARY).write_text("patient,mine\n")
    with pytest.raises(ValueError, match="summary.csv is no summary of prepared cases, and is not replaced"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert (tmp_path / "out" / SUMMARY).read_text() == "patient,mine\n" and len(list((tmp_path / "out").iterdir())) == 1


def test_a_ct_whose_name_is_no_text_is_prepared_and_listed(tmp_path, thorax):
    save_ct(tmp_path / "in" / os.fsdecode(b"caf\xe9.nii.gz"), thorax)
    (row,) = prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert row["status"] == "prepared" and (tmp_path / "out" / "caf?" / RECORD).is_file()
    assert "caf?.nii.gz" in (tmp_path / "out" / SUMMARY).read_text(encoding="utf-8")


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_stops_the_preparation_with_one_sentence_and_nothing_half_written(tmp_path, thorax, monkeypatch):
    for n in range(2):
        save_ct(tmp_path / f"in/{n}.nii.gz", thorax)
    whole = nibabel.save

    def later(image, path):
        return full() if "1" in path.parent.name.split(".")[1] and path.name == "lung.nii.gz" else whole(image, path)

    monkeypatch.setattr(nibabel, "save", later)
    with pytest.raises(OSError, match="the case .*1 could not be written \\(No space left on device\\): free some sp"):
        prepare_folder(tmp_path / "in", tmp_path / "out", SMALL)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["0"], "the finished case stays, alone"


def test_a_full_disk_while_caching_is_one_sentence_and_leaves_nothing(tmp_path, thorax, monkeypatch):
    save_ct(tmp_path / "a.nii.gz", thorax)

    def half(stream, **_):
        stream.write(b"half")
        full()

    monkeypatch.setattr(cache.np, "savez_compressed", half)
    cases = CTCases(find_cts(tmp_path / "a.nii.gz"), tmp_path / "cache", Grid.cube(32))
    with pytest.raises(OSError, match="could not be written \\(No space left on device\\): free some space, or give"):
        cases[0]
    assert not [*(tmp_path / "cache").iterdir()]


def test_settings_and_places_that_cannot_be_are_refused(tmp_path, thorax):
    save_ct(tmp_path / "in/a.nii.gz", thorax)
    for out in (tmp_path / "in/out", tmp_path):
        with pytest.raises(ValueError, match="lie inside each other"):
            prepare_folder(tmp_path / "in", out)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="there is no CT in .*empty; give a NIfTI file, or a folder"):
        prepare_folder(tmp_path / "empty", tmp_path / "out")
    for wrong, sentence in (({"voxels": 4}, "at least 8 voxels"), ({"side": 1e-9}, "side of 10 to 2000 mm"),
                            ({"side": 1e9}, "side of 10 to 2000 mm"), ({"window": (5, 5)}, "low < high"),
                            ({"space": "atlas"}, "space is patient or medsyn"),
                            ({"segmenter": "x"}, "segmenter is threshold or lungmask")):
        with pytest.raises(ValueError, match=sentence):
            Settings(**wrong)


def test_the_recipe_prints_counts_and_fails_in_one_sentence(tmp_path, thorax, capsys, monkeypatch):
    main = runpy.run_path(str(ROOT / "data/prepare_cts.py"))["main"]
    save_ct(tmp_path / "in/a.nii.gz", thorax)
    save_ct(tmp_path / "in/b.nii.gz", thorax[:, :, :3])
    main([str(tmp_path / "in"), str(tmp_path / "out"), "--voxels=32", "--space=medsyn"])
    out, err = capsys.readouterr()
    assert "1 prepared, 1 rejected" in out and "CTs: 2 cases to prepare" in err and "b: rejected: " in err
    record = json.loads((tmp_path / "out/a" / RECORD).read_text())
    assert record["window"] == [-1024, 600] and record["settings"]["space"] == "medsyn"
    for args in ([str(tmp_path / "in/b.nii.gz"), str(tmp_path / "o2")], [str(tmp_path / "in"), str(tmp_path / "in/x")],
                 [str(tmp_path / "none"), str(tmp_path / "o3")]):
        with pytest.raises(SystemExit) as stopped:
            main(args)
        err = capsys.readouterr().err.strip().splitlines()
        assert stopped.value.code == 2 and err[-1].startswith("error: ")


@pytest.mark.parametrize("text, sentence", [
    ("VolumeName,Findings_EN\na,b\n", "lacks the columns Impressions_EN"),
    ("", "lacks the columns VolumeName, Findings_EN, Impressions_EN"),
    ("VolumeName;Findings_EN;Impressions_EN\na;b;c\n", "VolumeName, Findings_EN, Impressions_EN, separated by commas"),
    ("VolumeName,Findings_EN,Impressions_EN\na.nii.gz,x,\nb,x,\na.nii.gz,y,\n", "a has two rows, the second in row 4"),
    ("VolumeName,Findings_EN,Impressions_EN\n,x,y\n", "row 2 of .* has no VolumeName"),
    ("VolumeName,Findings_EN,Impressions_EN\na,caf\xe9,\n", "cannot be read .* save it as CSV in UTF-8")])
def test_bad_report_tables_are_one_sentence(tmp_path, text, sentence):
    (tmp_path / "r.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=sentence) as caught:
        read_reports(tmp_path / "r.csv")
    assert "\n" not in str(caught.value)


def test_a_volume_with_two_rows_of_metadata_is_refused(tmp_path):
    row = 'a.nii.gz,1,0,"[1, 1]",1\n'
    (tmp_path / "m.csv").write_text("VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n" + 2 * row)
    with pytest.raises(ValueError, match="a has two rows"):
        read_calibrations(tmp_path / "m.csv")


@pytest.mark.parametrize("record", ["null", "3", "[]", '{"id": "a", "space": "patient", "extent": [1, 1, 1], '
                                    '"window": [0, 1], "report": "", "row": [1]}'])
def test_a_record_that_is_none_is_refused_by_name(tmp_path, thorax, record):
    save_ct(tmp_path / "a" / "ct.nii.gz", thorax)
    (tmp_path / "a" / RECORD).write_text(record)
    with pytest.raises(ValueError, match=f"{RECORD} cannot be read .it is damaged"):
        find_cts(tmp_path)


@pytest.mark.parametrize("option", ["--side=nan", "--window=[nan,nan]", "--voxels=many", "--work=2"])
def test_an_option_that_cannot_be_is_one_sentence(tmp_path, capsys, option):
    main = runpy.run_path(str(ROOT / "data" / "prepare_cts.py"))["main"]
    with pytest.raises(SystemExit) as stopped:
        main([str(tmp_path), str(tmp_path / "out"), option])
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
