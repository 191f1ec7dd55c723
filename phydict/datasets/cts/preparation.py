"""From folders of CTs, DICOM or NIfTI, to prepared cases: in parallel, resumable, with a table of what was rejected."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np

from phydict.datasets.cts.anatomy import MASKS, body_mask, lung_box_centre, lung_box_size, segment
from phydict.datasets.cts.ct_case import SEGMENTATION_MM
from phydict.datasets.cts.prepared import RECORD, VOLUME, read_record, write_prepared
from phydict.datasets.cts.reading import Calibration, check_hu
from phydict.datasets.cts.resampling import covering_grid, to_grid
from phydict.datasets.cts.segmentations import lungs_by_lungmask, read_segmentation, segmentations_beside
from phydict.datasets.cts.sources import Source, find_sources
from phydict.datasets.cts.spaces import Settings
from phydict.grid import Grid
from phydict.runtime.files import atomic_directory, atomic_removal, atomic_write, check_replaceable, remove_leftovers
from phydict.runtime.progress import CaseProgress
from phydict.runtime.progress_log import log_progress
from phydict.runtime.reading import Unreadable, not_written
from phydict.runtime.warning import warn

SUMMARY = "summary.csv"
COLUMNS = ("id", "status", "reason", "remark", "source", "kind", "slices", "spacing_x_mm", "spacing_y_mm",
           "spacing_z_mm", "extent_z_mm", "lungs_by", "lung_ml", "lungs_inside", "lung_width_mm", "lung_depth_mm",
           "lung_height_mm", "masks", "window_low", "window_high")


def prepare_folder(cts: str | Path, out: str | Path, settings: Settings = Settings(), workers: int = 1,
                   **tables) -> list[dict]:
    """Prepares every CT below `cts` into `out`, one folder each, and writes out/summary.csv.

    Finished cases are kept where their input is the same: the bytes of its files, its report and its calibration. Where
    it is another, or the case says nothing of it, a line tells so, and the CT is prepared again. A case appears only
    when it is complete, and takes the place of nothing but a case that was prepared here, which also goes where its CT
    is rejected now; cases whose CT is not below `cts` are warned of. workers: processes.
    tables: reports, metadata, fixed, first_reconstruction and exclude, as for `find_cts`.
    Returns the summary's rows, by COLUMNS, status being prepared or rejected.
    Raises ValueError for folders inside each other, for an `out` of other settings and for what no preparation wrote in
    the place of a case or of the summary, and OSError, in one sentence, where a case cannot be written; a CT that
    cannot be prepared is rejected with the reason.
    """
    root, out = Path(cts), Path(out)
    if out.resolve().is_relative_to(root.resolve()) or root.resolve().is_relative_to(out.resolve()):
        raise ValueError(f"the CTs' folder {root} and the output folder {out} lie inside each other; "
                         "give an output folder elsewhere")
    if workers < 1:
        raise ValueError(f"workers must be at least 1, but {workers} was given")
    sources = find_sources(root, **tables)
    _check_summary(out / SUMMARY)
    remove_leftovers(out)
    rows = _kept(sources, out, settings, workers)
    left = [source for source in sources if source.id not in rows]
    others = sorted({path.parent.name for path in out.glob(f"[!.]*/{RECORD}")} - {source.id for source in sources})
    if others:
        warn(f"{out} holds {_cases(others)} of no CT that is taken from {root}, to be trained on with the rest: remove "
             f"{', '.join(others[:3])}{', ...' * (len(others) > 3)} if that is not meant")
    with CaseProgress() as progress:
        progress.begin("CTs", len(left), verb="prepare", out=out)
        for row in _prepared(left, out, settings, workers):
            rows[row["id"]] = row
            progress.case(row["id"])
            progress.finished(row["status"] + (f": {row['reason']}" if row["reason"] else ""))
    summary = [rows[source.id] for source in sources]
    _write_summary(out / SUMMARY, summary)
    return summary


def _kept(sources: list[Source], out: Path, settings: Settings, workers: int) -> dict[str, dict]:
    """The rows by id of the cases that are already there and of these inputs; tells which others are prepared again.

    Every file of an input whose case is there is read once, by as many threads as there are workers.
    """
    there = [source for source in sources if os.path.lexists(out / source.id)]
    if there:
        log_progress(f"{out} holds {_cases(there)}, whose inputs are compared with what they were", event="compare",
                     cases=len(there), out=str(out))
    with ThreadPoolExecutor(workers) as threads:
        found = list(threads.map(lambda s: _finished(out / s.id, settings, s.fingerprint), there))
    again = [source for source, row in zip(there, found) if row is None]
    if again:
        names = ", ".join(source.id for source in again[:3]) + ", ..." * (len(again) > 3)
        log_progress(f"{_cases(again)} in {out} will be prepared again and replaced ({names}): a CT, segmentation, "
                     "report or calibration is another than it was, or was not recorded then",
                     event="again", cases=[source.id for source in again], out=str(out))
    return {source.id: row for source, row in zip(there, found) if row is not None}


def _cases(sources: list) -> str:
    return f"{len(sources)} case{'' if len(sources) == 1 else 's'}"


def _finished(folder: Path, settings: Settings, fingerprint: Callable[[], dict]) -> dict | None:
    """The row of a case that is already in its folder and of this input, else None, where a new one may take its place.

    Raises ValueError where what is there must stay: what no preparation wrote, and a case of other settings.
    """
    if not os.path.lexists(folder):
        return None
    if not (folder / RECORD).is_file():
        raise ValueError(f"{folder} is in the place of a prepared case, but holds no {RECORD}, and is not replaced: "
                         "move it away, or give another output folder")
    record = read_record(folder / VOLUME)
    if record.get("settings") != json.loads(json.dumps(asdict(settings))):
        raise ValueError(f"{folder} was prepared with other settings; give another output folder, or remove that one")
    row = record["row"]
    with suppress(ValueError, OSError):
        if record.get("fingerprint") == fingerprint():
            return row
    masks = str(row.get("masks", "")).split()
    check_replaceable(folder, {RECORD, VOLUME, *(f"{mask}.nii.gz" for mask in masks)}, "output folder")
    return None


def _prepared(sources: list[Source], out: Path, settings: Settings, workers: int) -> Iterator[dict]:
    if workers == 1 or len(sources) < 2:
        yield from (prepare_source(source, out, settings) for source in sources)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when a process starts: one thread for each of these
    pool = ProcessPoolExecutor(min(workers, len(sources)), multiprocessing.get_context("spawn"), _end_with_parent)
    try:
        with _without_ctrl_c():  # which the workers inherit
            cases = [pool.submit(prepare_source, source, out, settings) for source in sources]
        for done in as_completed(cases):
            yield done.result()
    except BrokenProcessPool as error:
        raise OSError("a worker process ended before its case was done, perhaps for want of memory; give fewer workers "
                      "and run the same command again, finished cases are kept") from error
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Ctrl-C waits for the block's end, where the system lets it."""
    if sys.platform == "win32":
        yield
    else:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """In a worker: ends when the parent does."""
    def end_after(parent) -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_after, args=(multiprocessing.parent_process(),), daemon=True).start()


def prepare_source(source: Source, out: Path, settings: Settings) -> dict:
    """Prepares one CT into out/<id>; returns its row of the summary, in which it may be rejected. An earlier case
    of a CT that is read and rejected is removed.

    Raises OSError, in one sentence, where the case cannot be written; nothing of it is left then.
    """
    row = dict.fromkeys(COLUMNS, "") | {"id": source.id, "source": str(source.place),
                                        "kind": "DICOM" if source.is_dicom else "NIfTI"}
    folder = out / source.id
    with warnings.catch_warnings(record=True) as remarks:
        warnings.simplefilter("always", UserWarning)
        try:
            fingerprint = source.fingerprint()  # before the voxels: what changes meanwhile is seen by the next run
            grid, images, facts = _place(*source.load(), segmentations_beside(source.beside), settings,
                                         source.calibration)
        except (ValueError, OSError) as error:
            facts = {"status": "rejected", "reason": " ".join(str(error).split())}
            if not isinstance(error, OSError | Unreadable):  # what cannot be read may be read by the next run
                atomic_removal(folder, lambda: _finished(folder, settings, dict) is None)
        row["remark"] = "; ".join(str(w.message) for w in remarks if w.category is UserWarning)
    if "reason" in facts:
        return row | facts
    row |= facts | {"status": "prepared", "window_low": settings.window[0], "window_high": settings.window[1]}
    record = {"id": source.id, "space": settings.space, "extent": settings.extent, "window": settings.window,
              "report": source.report, "settings": asdict(settings), "fingerprint": fingerprint, "row": row}
    try:
        with atomic_directory(folder, lambda: _finished(folder, settings, lambda: fingerprint) is None) as partial:
            write_prepared(partial, grid, images, record)
    except OSError as error:
        raise not_written(f"the case {folder}", error, "give another output folder, and run the same command "
                          "again, finished cases are kept") from error
    return row


def _place(hu: np.ndarray, affine: np.ndarray, beside: dict[str, tuple[Path, ...]],
           settings: Settings, calibration: Calibration | None) -> tuple[Grid, dict[str, np.ndarray], dict]:
    """The grid of a case, its images on that grid ("ct" in HU, masks), and what the summary says of it.

    calibration: as `read_segmentation` takes it. Raises ValueError where no lungs are found or a segmentation does not
    fit.
    """
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    facts = {"slices": hu.shape[2]} | {f"spacing_{a}_mm": round(float(s), 4) for a, s in zip("xyz", spacing)}
    facts["extent_z_mm"] = round(float(spacing[2] * hu.shape[2]), 1)
    check_hu(hu, "the CT")
    hu = hu.clip(settings.outside)
    work = covering_grid(hu.shape, affine, SEGMENTATION_MM)
    coarse = to_grid(hu, affine, work, settings.outside)
    segmented, known = segment(coarse, work.spacing)
    masks = {name: (mask, work.affine) for name, mask, here in zip(MASKS, segmented, known) if here}
    masks["body"] = body_mask(coarse, work.spacing), work.affine
    facts["lungs_by"] = "file" if "lung" in beside else settings.segmenter
    if facts["lungs_by"] == "lungmask":
        masks["lung"] = lungs_by_lungmask(hu), affine
    masks |= {name: (read_segmentation(files, hu.shape, affine, calibration), affine) for name, files in beside.items()}
    lung = to_grid(masks["lung"][0], masks["lung"][1], work, 0.0) if "lung" in masks else np.zeros(1)
    if not (lung > 0.5).any():
        raise ValueError("no lungs were found; give a chest CT in HU, or lay a lung segmentation beside it")
    size = lung_box_size(lung, work.spacing)
    grid = settings.grid(lung_box_centre(lung, work.affine), size)
    images = {"ct": to_grid(hu, affine, grid, settings.outside)}
    images |= {name: to_grid(mask, place, grid, 0.0) for name, (mask, place) in masks.items()}
    volume = lung.sum() * np.prod(work.spacing)
    facts |= {"lung_ml": round(float(volume) / 1000), "masks": " ".join(masks),
              "lungs_inside": round(min(1.0, float(images["lung"].sum() * np.prod(grid.spacing) / volume)), 3)}
    facts |= {f"lung_{side}_mm": float(n) for side, n in zip(("width", "depth", "height"), size)}
    return grid, images, facts


def _check_summary(file: Path) -> None:
    """Raises ValueError where a table of someone else's would be replaced."""
    if os.path.lexists(file) and not (file.is_file() and file.read_bytes().startswith(b"id,status,")):
        raise ValueError(f"{file} is no summary of prepared cases, and is not replaced: move it away, or give another "
                         "output folder")


def _write_summary(file: Path, rows: list[dict]) -> None:
    try:
        with atomic_write(file) as part, part.open("w", newline="", encoding="utf-8", errors="replace") as stream:
            table = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
    except OSError as error:
        raise not_written(f"the summary {file}", error, "give another output folder, and run the same command again, "
                          "finished cases are kept") from error
