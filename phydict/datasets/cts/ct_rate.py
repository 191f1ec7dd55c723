"""CT-RATE's folders, or any folder of chest CTs as NIfTI, as a list of Cases cached on disk.

CT-RATE (arXiv 2403.17834) names its volumes (train|valid)_<patient>_<scan>_<reconstruction>.nii.gz. Its v2 files
(`*_fixed` folders) carry their own HU and spacing: `fixed=True` trusts the header. The headers of v1 are blank:
`fixed=False` takes HU scale, spacing and orientation from the metadata table.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from phydict.datasets.case import Case
from phydict.datasets.cts.cache import key_of, pack_case, read_arrays, unpack_case, write_arrays
from phydict.datasets.cts.ct_case import prepare_ct
from phydict.datasets.cts.ct_rate_tables import read_calibrations, read_reports
from phydict.datasets.cts.prepared import VOLUME, is_prepared, read_prepared, read_record
from phydict.datasets.cts.reading import Calibration, case_id
from phydict.datasets.cts.segmentations import is_segmentation, mask_files
from phydict.datasets.itk_file import ENDINGS, voxel_files
from phydict.datasets.natural_order import natural_order
from phydict.datasets.nifti_file import NIFTI
from phydict.grid import Grid
from phydict.runtime.files import files_below
from phydict.runtime.progress_log import log_progress
from phydict.runtime.reading import name_of, read_ids
from phydict.runtime.warning import heard, warn
from phydict.units import HUWindow

NAME = re.compile(r"(?P<patient>(?:train|valid)_\d+)_(?P<scan>[a-z]+)_(?P<reconstruction>\d+)", re.IGNORECASE)
PACKED = ("volume", "masks", "has_masks", "affine", "centred_on")
"""The parts of a prepared CT that the cache holds."""

CACHE_VERSION = 2
"""Raise it when `prepare_ct` changes its result, so that older caches are not read."""


@dataclass(frozen=True)
class CTFile:
    """A CT on disk. report: "" where there is none. calibration: None where the file's own header is trusted."""

    path: Path
    id: str
    report: str = ""
    calibration: Calibration | None = None


def patient_of(id: str) -> str:
    """The patient of a Case id: CT-RATE's train_12 of train_12_a_1, `folder` of `folder__name`, else the id itself."""
    match = NAME.fullmatch(id)
    return match["patient"] if match else id.split("__")[0]


def as_one_patient(ids: Iterable[str]) -> str:
    """What to tell where several CTs are the scans of a single patient, since all lie in one subfolder; else ""."""
    ids = list(ids)
    folders = {id.partition("__")[0] for id in ids if "__" in id and not NAME.fullmatch(id)}
    if len(ids) < 2 or {patient_of(id) for id in ids} != folders or len(folders) > 1:
        return ""
    return (f"; {len(ids)} CTs in the subfolder {folders.pop()} count as one patient's, give that folder if they are "
            "several patients'")


def scan_of(id: str) -> str:
    """CT-RATE's scan train_12_a of train_12_a_1, else the id itself."""
    match = NAME.fullmatch(id)
    return f"{match['patient']}_{match['scan']}" if match else id


@dataclass(frozen=True)
class CTSource:
    """Which CTs of a folder are taken, and what belongs to them.

    Args:
        reports: CT-RATE's table of reports, or the folder it is in; none given: looked for beside the CTs
        metadata: CT-RATE's metadata table, needed where headers are not fixed
        fixed: whether the NIfTI headers are right (CT-RATE's *_fixed folders and ordinary archives)
        first_reconstruction: keep one volume per scan
        exclude: a text file of case ids or files to leave out, one a line
    """

    reports: str | None = None
    metadata: str | None = None
    fixed: bool = True
    first_reconstruction: bool = False
    exclude: str | None = None

    def find(self, cts: str | Path) -> list[CTFile]:
        """The CTs of a file or folder, as `find_cts`."""
        return find_cts(cts, **vars(self))


class NoNIfTI(FileNotFoundError):
    """There is no NIfTI file where CTs are looked for."""


def find_cts(root: str | Path, reports: str | Path | None = None, metadata: str | Path | None = None,
             fixed: bool = True, first_reconstruction: bool = False,
             exclude: str | Path | None = None) -> list[CTFile]:
    """The CTs under `root`, a NIfTI file or a folder of any depth, linked folders included, in natural order; a
    MetaImage or NRRD file is read as well, and so is a folder of these without a NIfTI file.

    reports, metadata: CT-RATE's CSV tables or folders of them; left out, radiology_text_reports/ (and, for
    fixed=False, metadata/) is looked for in `root` and the three folders above it. No reports at all is fine.
    fixed: trust the headers; False reads CT-RATE v1 by its metadata. Where the folder holds both versions of a volume,
    the one of `fixed` is read. first_reconstruction: keep one volume per scan. exclude: a text file of ids or
    files to leave out, one a line (CT-RATE's no_chest_*.txt).
    Segmentations beside CTs are passed over. Of cases prepared by data/prepare_cts.py the volume alone is taken, with
    their own ids, and with their own reports where no table has one, or a blank one.
    Ids are file names without ending; outside CT-RATE's names, a file in a subfolder gets `<first subfolder>__<name>`,
    or all its folders where two CTs would have the same id.
    Warns of CTs that are the same file. Raises FileNotFoundError where there is no NIfTI, ValueError for ids found
    twice, v1 volumes without metadata, and a given table of reports without any of the CTs; one that was found by
    itself is warned of, and so is one whose rows of them are blank.
    """
    root = Path(root)
    paths = _ct_files(root)
    short = Counter(_id(path, root) for path in paths)
    files: dict[str, Path] = {}
    for path in paths:
        id = _id(path, root)
        id = id if short[id] == 1 else _id(path, root, every_folder=True)
        if id in files and NAME.fullmatch(id) and _is_fixed(path) != _is_fixed(files[id]):
            path = path if _is_fixed(path) == fixed else files[id]
        elif id in files:
            raise ValueError(f"{files[id]} and {path} would both become case {id}; rename one of them")
        files[id] = path
    ids = sorted(files, key=natural_order)
    if exclude:
        ids = without_excluded(ids, exclude, root)
    if first_reconstruction:
        ids = first_of_scans(ids)
    _warn_of_links({id: files[id].resolve() for id in ids}, root)
    table_given = reports is not None
    reports = reports or _beside(root, "radiology_text_reports")
    texts = read_reports(reports) if reports else {}
    by_scan = {scan_of(id): text for id, text in texts.items()}
    reports_of = {id: texts.get(id, by_scan.get(scan_of(id))) for id in ids}
    if (table_given or texts) and all(text is None for text in reports_of.values()):
        first = f"the first report is of {next(iter(texts))}, " if texts else ""
        message = (f"none of the {len(texts)} reports in {reports} is of one of the {len(ids)} CTs in {root} ({first}"
                   f"the first CT is {ids[0]})")
        if table_given:
            raise ValueError(f"{message}: give the table of these CTs, or leave out data.source.reports")
        warn(message)
    elif texts and not any(reports_of.values()):
        warn_of_blank(reports, ids)
    cts = [CTFile(files[id], id, text or _own_report(files[id])) for id, text in reports_of.items()]
    if texts:
        log_reports(ids, [ct.id for ct in cts if not ct.report])
    return cts if fixed else _calibrated(cts, metadata or _beside(root, "metadata"))


def warn_of_blank(reports: str | Path | None, ids: list[str]) -> None:
    """Warns that a table has rows of these CTs, and no report in any."""
    warn(f"{reports} has no report of any of the {len(ids)} CTs, the first of which is {ids[0]}: in their rows, "
         "Findings_EN and Impressions_EN are blank")


def log_reports(ids: list[str], without: list[str]) -> None:
    """Tells how many of the CTs have a report, where some have and the ids `without` have none."""
    if 0 < len(without) < len(ids):
        count = len(ids) - len(without)
        log_progress(f"reports for {count} of {len(ids)} CTs; the first without is {without[0]}", event="reports",
                     reports=count, cts=len(ids), without=without[0])


def first_of_scans(ids: list[str]) -> list[str]:
    """Of ids in natural order, one of each scan."""
    return [id for n, id in enumerate(ids) if n == 0 or scan_of(ids[n - 1]) != scan_of(id)]


def without_excluded(ids: list[str], exclude: str | Path, root: Path) -> list[str]:
    """The ids that a text file does not list; in it a/b/x.nii.gz, in `root` or absolute, means the case a__b__x or,
    where there is none, a__x or x.

    Warns where it lists other ids alone. Raises FileNotFoundError where it lists all.
    """
    lines, known, listed = read_ids(exclude, "data.source.exclude"), set(ids), set()
    for line in lines:
        path, name = Path(line), case_id(line)
        folders = (path.relative_to(root.absolute()) if path.is_relative_to(root.absolute()) else path).parts[:-1]
        forms = ["__".join((*outer, name)) for outer in (folders, folders[:1])]
        listed.add(next((form for form in forms if form in known), name))
    left = [id for id in ids if id not in listed]
    if lines and len(left) == len(ids):
        warn(f"none of the {len(lines)} lines of {exclude} is one of the {len(ids)} CTs in {root}, so that nothing is "
             f"excluded (the first line is {lines[0]}, the first CT is {ids[0]}): one id a line is read")
    if not left:
        raise FileNotFoundError(f"every CT in {root} is excluded by {exclude}; give another list or folder")
    return left


def _calibrated(cts: list[CTFile], metadata: str | Path | None) -> list[CTFile]:
    if metadata is None:
        raise ValueError("headers that are not fixed need CT-RATE's metadata table, but none was given or found; "
                             "give it as data.source.metadata")
    table = read_calibrations(metadata)
    missing = [ct.id for ct in cts if ct.id not in table]
    if missing:
        raise ValueError(f"{len(missing)} of {len(cts)} volumes are not in the metadata {metadata}, the first is "
                         f"{missing[0]}; give the table of these volumes, or data.source.fixed true if they are right")
    return [replace(ct, calibration=table[ct.id]) for ct in cts]


def _ct_files(root: Path) -> list[Path]:
    if root.is_file():
        if not root.name.lower().endswith((*NIFTI, *ENDINGS)):
            raise NoNIfTI(f"{root} is not a NIfTI file; give a .nii or .nii.gz file, or a folder of them")
        return [root]
    if not root.is_dir():
        raise NoNIfTI(f"there is no folder or file {root}; give the folder that holds the CTs")
    every = files_below(root)
    files = [p for p in every if p.name.lower().endswith(NIFTI) and not is_segmentation(p)
             and (p.name == VOLUME or not is_prepared(p))] or [p for p in every if p.name.lower().endswith(ENDINGS)]
    if not files:
        held = f"its {len(every)} files are of other kinds" if every else "it is empty"
        raise NoNIfTI(f"there is no .nii or .nii.gz file in {root} ({held}); give a folder of NIfTI CTs, or "
                      "prepare DICOM series with data/prepare_cts.py first")
    return files


def _id(path: Path, root: Path, every_folder: bool = False) -> str:
    if is_prepared(path):
        return name_of(path.absolute().parent)
    name = case_id(path)
    folders = path.relative_to(root).parts[:-1] if root.is_dir() and not NAME.fullmatch(name) else ()
    return "__".join((*map(name_of, folders if every_folder else folders[:1]), name))


def _warn_of_links(files: dict[str, Path], root: Path) -> None:
    """Warns where ids have the same file."""
    first: dict[Path, str] = {}
    again = [id for id, file in files.items() if first.setdefault(file, id) != id]
    if again:
        file = files[again[0]]
        warn(f"{len(again)} of the {len(files)} CTs in {root} are links to files of others ({again[0]} is {file}, as "
             f"{first[file]} is), so that one may be held out and trained on: remove one of them, or exclude it by "
             "data.source.exclude")


def _own_report(path: Path) -> str:
    return read_record(path)["report"] if is_prepared(path) else ""


def _is_fixed(path: Path) -> bool:
    return any(part.endswith("_fixed") for part in path.parts)


def _beside(root: Path, name: str) -> Path | None:
    places = [folder / name for folder in (root, *root.absolute().parents[:3])]
    return next((place for place in places if place.is_dir() and any(place.glob("*.csv"))), None)


def split_by_patient(ids: list[str], fraction: float, seed: int = 0) -> tuple[list[str], list[str]]:
    """(training ids, held-out ids): about `fraction` of the patients are held out, all their scans together.

    Patients are in the order of a hash of seed and name, so that one more or fewer moves at most one other. With two or
    more patients and 0 < fraction < 1 neither side is empty. Raises ValueError for a fraction outside [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"the held-out fraction must lie in [0, 1], but {fraction} was given")
    patients = sorted({patient_of(id) for id in ids}, key=lambda patient: key_of([seed, patient]))
    count = round(fraction * len(patients))
    if 0 < fraction < 1 and len(patients) > 1:
        count = min(max(count, 1), len(patients) - 1)
    held = set(patients[:count])
    return [id for id in ids if patient_of(id) not in held], [id for id in ids if patient_of(id) in held]


def load_case(ct: CTFile, grid: Grid, window: HUWindow) -> Case:
    """The Case of a CT, prepared now or read as it was prepared. Raises what `prepare_ct` and `read_prepared` raise."""
    case = read_prepared(ct.path, grid, window) if is_prepared(ct.path) else prepare_ct(
        ct.path, grid, window, id=ct.id, calibration=ct.calibration)
    return case | {"id": ct.id, "report": ct.report}


class CTCases(Dataset):
    """Cases prepared from CT files, one by one when first needed, then read from a cache folder.

    cts: what `find_cts` returns. cache: a folder for the prepared cases, made when missing; None keeps nothing. A case
    is prepared anew when its file, grid, window or calibration changes, or a mask of one that was prepared before.
    Volumes are stored to half precision (0.5 HU), masks to 1/255; a case is the same before and after caching. What was
    warned of when it was prepared is warned of once when it is read. The folder of the CTs is never written to.
    """

    def __init__(self, cts: list[CTFile], cache: str | Path | None, grid: Grid = Grid.cube(64),
                 window: HUWindow = HUWindow()):
        self.cts, self.grid, self.window = list(cts), grid, window
        self.cache = None if cache is None else Path(cache)
        self.told = torch.zeros(len(self.cts), dtype=torch.bool).share_memory_()  # by any process that loads cases

    def __len__(self) -> int:
        return len(self.cts)

    def __getitem__(self, index: int) -> Case:
        ct = self.cts[index]
        file = self.cache and self.cache / f"{ct.id}-{self.key(ct)}.npz"
        packed = read_arrays(file) if file else None
        if packed is None:
            with heard() as texts:
                packed = pack_case(load_case(ct, self.grid, self.window), PACKED)
            if file:
                write_arrays(file, packed | ({"warnings": np.array(texts)} if texts else {}))
        warnings = packed.pop("warnings", None)
        if warnings is not None and not self.told[index]:
            for text in warnings:
                warn(str(text))
        self.told[index] = True
        return unpack_case(packed) | {"id": ct.id, "report": ct.report}

    def key(self, ct: CTFile) -> str:
        """Of a CT as it is prepared here: another file, grid, window or calibration has another, and of one that was
        prepared before so have other masks."""
        stat = ct.path.stat()
        beside = mask_files(ct.path) if is_prepared(ct.path) else voxel_files(ct.path)
        others = [[file.name, file.stat().st_mtime_ns, file.stat().st_size] for file in beside]
        parts = [CACHE_VERSION, str(ct.path.resolve()), stat.st_mtime_ns, stat.st_size, self.grid.to_dict(),
                 asdict(self.window), asdict(ct.calibration) if ct.calibration else None]
        return key_of([*parts, *others])
