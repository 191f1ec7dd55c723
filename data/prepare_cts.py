"""Prepares CTs for training a prior: python data/prepare_cts.py <folder of DICOM series or NIfTI> <output folder>"""

import sys
from collections import Counter
from pathlib import Path

from phydict.datasets.cts.preparation import SUMMARY, prepare_folder
from phydict.datasets.cts.spaces import Settings, atlas_lungs
from phydict.runtime.console import check_writable, cli_errors, quiet
from phydict.runtime.progress_log import progress_options, run_command


def prepare(cts: str, out: str, voxels: int = 256, side: float = 384.0, space: str = "patient",
            window: tuple[float, float] | None = None, segmenter: str = "threshold", atlas: str | None = None,
            workers: int = 1, reports: str | None = None, metadata: str | None = None, fixed: bool = True,
            first_reconstruction: bool = False, exclude: str | None = None) -> None:
    """Prepares the CTs of a folder for training a prior; a stopped run resumes.

    Args:
        cts: a folder of DICOM series or NIfTI CTs, at any depth, or one NIfTI file
        out: the folder for the prepared cases, outside that of the CTs
        voxels: voxels per side; training may use a divisor of it
        side: mm of the cube around the lungs
        space: patient, or medsyn for an approximation of MedSyn's atlas space
        window: the HU window to record; none given: -1000 to 1000, in MedSyn's space -1024 to 600
        segmenter: how lungs are found where no segmentation lies beside the CT: threshold, or lungmask (an extra)
        atlas: a copy of MedSyn's atlas lung mask, from which its lungs' box is measured
        workers: processes
        reports: CT-RATE's table of reports, or the folder it is in; none given: looked for beside the CTs
        metadata: CT-RATE's metadata table, needed where headers are not fixed
        fixed: whether the NIfTI headers are right (CT-RATE's *_fixed folders and ordinary archives)
        first_reconstruction: keep one volume per scan
        exclude: a text file of case ids or files to leave out, one a line
    """
    window = window or ((-1024.0, 600.0) if space == "medsyn" else (-1000.0, 1000.0))
    settings = Settings(voxels, side, window, space, segmenter, **(atlas_lungs(Path(atlas)) if atlas else {}))
    check_writable(Path(out), "output folder")
    rows = prepare_folder(cts, out, settings, workers, reports=reports, metadata=metadata, fixed=fixed,
                          first_reconstruction=first_reconstruction, exclude=exclude)
    counts = Counter(row["status"] for row in rows)
    print(f"{counts['prepared']} prepared, {counts['rejected']} rejected; see {Path(out) / SUMMARY}")
    if not counts["prepared"]:
        raise ValueError(f"none of the {len(rows)} CTs could be prepared; the first: {rows[0]['reason']}")


def main(args: list[str] | None = None) -> None:
    """Command line; a bad input ends in one sentence and exit code 2."""
    given = sys.argv[1:] if args is None else args
    with progress_options(given), cli_errors(), quiet():
        run_command(prepare, given, positional=True)


if __name__ == "__main__":
    main()
