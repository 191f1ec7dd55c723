"""What is uncertain of a case's geometry, where `--calibrate` seeks its poses."""

from __future__ import annotations

from phydict.datasets.case import Case
from phydict.runtime.warning import warn
from phydict.xray.poses.uncertain import Uncertain


def uncertain_of(case: Case) -> Uncertain:
    """What a case's geometry file says not to know exactly; with a warning, of radiographs whose tags are their
    geometry, what is usual.

    Raises ValueError where a file of other measured ones does not say it.
    """
    if case["uncertain"] is None:
        raise ValueError(f"--calibrate needs to know what {case['description'].source} is not sure of: state "
                         "`uncertain:` there, such as {detector_shift_mm: 5, rotation_degrees: 2}, or leave "
                         "--calibrate out")
    if case["description"].uncertain is None:
        stated = ", ".join(f"{name}: {value:g}" for name, value in vars(case["uncertain"]).items() if value)
        warn(f"the tags do not say how exactly source and detector stood: taken is what is usual where a patient turns "
             f"by hand ({stated}); state `uncertain:` in {case['description'].source.name} for other values")
    return case["uncertain"]
