"""The CTs of a folder that can be prepared, NIfTI files and DICOM series, each with a name of its own."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

import numpy as np

from phydict.datasets.cts.ct_rate import (
    CTFile,
    NoNIfTI,
    find_cts,
    first_of_scans,
    log_reports,
    warn_of_blank,
    without_excluded,
)
from phydict.datasets.cts.ct_rate_tables import read_reports
from phydict.datasets.cts.ct_series import Series, find_series, load_series
from phydict.datasets.cts.reading import Calibration, case_id, load_ct
from phydict.datasets.cts.segmentations import segmentations_beside
from phydict.datasets.itk_file import ENDINGS, voxel_files
from phydict.runtime.files import file_crc32
from phydict.runtime.reading import reading


@dataclass(frozen=True)
class Source:
    """A CT to prepare. beside: its path without ending, beside which segmentations lie. report: radiology text."""

    id: str
    ct: CTFile | Series
    beside: Path
    report: str = ""

    @property
    def is_dicom(self) -> bool:
        return isinstance(self.ct, Series)

    @property
    def place(self) -> Path:
        return self.ct.folder if isinstance(self.ct, Series) else self.ct.path

    @property
    def calibration(self) -> Calibration | None:
        """Of a CT without a usable header."""
        return None if isinstance(self.ct, Series) else self.ct.calibration

    def load(self) -> tuple[np.ndarray, np.ndarray]:
        """HU (X, Y, Z) in RAS+ and the affine. Raises ValueError and OSError."""
        return load_series(self.ct) if isinstance(self.ct, Series) else load_ct(self.ct.path, self.ct.calibration)

    def fingerprint(self) -> dict:
        """What identifies this input, as plain JSON values: the number, bytes and contents of its files, those of its
        segmentations included, its report and its calibration. Reads every file once. Raises ValueError and OSError."""
        parts = {"ct": self.ct.files if isinstance(self.ct, Series) else (self.ct.path, *voxel_files(self.ct.path))}
        parts |= segmentations_beside(self.beside)
        files = [file for part in parts.values() for file in part]
        crc = 0
        for name, part in parts.items():
            crc = crc32(name.encode(), crc)
            for file in part:
                with reading(file, "see that it is there and may be read"):
                    crc = file_crc32(file, crc)
        return {"files": len(files), "bytes": sum(file.stat().st_size for file in files), "crc32": crc,
                "report_crc32": crc32(self.report.encode()), "calibration": str(self.calibration)}


def find_sources(root: Path, first_reconstruction: bool = False, exclude: str | Path | None = None,
                 **tables) -> list[Source]:
    """Every DICOM series and CT of `find_cts` below `root`, beside series NIfTI alone; options: as for `find_cts`.

    A series is named as a NIfTI file in its folder's place would be, `<first subfolder>__<folder>`; where that is not
    enough, by all its folders, then with its SeriesNumber, then with a count. A list to exclude has these
    names, and so has, where there are series alone, a given table of reports.
    Raises FileNotFoundError where there is none, what `find_cts` raises, and ValueError for a given table of reports
    without any of the CTs.
    """
    sources = _found(root, tables)
    ids = [source.id for source in sources]
    if exclude:
        ids = without_excluded(ids, exclude, root)
    if first_reconstruction:
        ids = first_of_scans(ids)
    left = set(ids)
    return [source for source in sources if source.id in left]


def _found(root: Path, tables: dict) -> list[Source]:
    series = find_series(root) if root.is_dir() else []
    try:
        cts = find_cts(root, **tables)
        if series and cts[0].path.name.lower().endswith(ENDINGS):
            raise NoNIfTI
    except NoNIfTI:
        if not series:
            raise FileNotFoundError(f"there is no CT in {root}; give a NIfTI file, or a folder that holds NIfTI files "
                                    "or DICOM series") from None
        return _reported(_named(series, root, set()), tables.get("reports"))
    sources = [Source(ct.id, ct, ct.path.with_name(case_id(ct.path)), ct.report) for ct in cts]
    return sources + _named(series, root, {ct.id for ct in cts})


def _reported(sources: list[Source], reports: str | Path | None) -> list[Source]:
    texts = read_reports(reports) if reports is not None else {}
    if reports is not None and not any(source.id in texts for source in sources):
        raise ValueError(f"none of the {len(texts)} reports in {reports} is of one of the {len(sources)} DICOM series "
                         f"(the first is {sources[0].id}): name them so in the table, or leave it out")
    if reports is not None:
        ids = [source.id for source in sources]
        without = [id for id in ids if not texts.get(id)]
        if without == ids:
            warn_of_blank(reports, ids)
        log_reports(ids, without)
    return [replace(source, report=texts.get(source.id, "")) for source in sources]


def _named(series: list[Series], root: Path, taken: set[str]) -> list[Source]:
    def forms(s: Series) -> tuple[str, ...]:
        parts = s.folder.relative_to(root).parts or (s.folder.absolute().name,)
        short, full = "__".join(dict.fromkeys((parts[0], parts[-1]))), "__".join(parts)
        return short, full, "__".join(part for part in (full, s.number) if part)

    counts = [Counter(names) for names in zip(*(forms(s) for s in series))]
    folders = Counter(s.folder for s in series)
    sources = []
    for s in series:
        names = forms(s)
        id = next((name for name, count in zip(names, counts) if count[name] == 1 and name not in taken), names[-1])
        n = 1
        while id in taken:
            n += 1
            id = f"{names[-1]}__{n}"
        taken.add(id)
        name = s.folder.absolute().name + (f"__{s.number}" if folders[s.folder] > 1 else "")
        sources.append(Source(id, s, s.folder.absolute().with_name(name)))
    return sources
