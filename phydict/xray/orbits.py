"""Where sources and detectors stand on a circle or a line, as vectors in world millimetres (RAS+)."""

from __future__ import annotations

import numpy as np

Poses = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Sources, detectors' centres, and steps from column to column and from row to row, each (K, 3)."""

SOURCE_TO_DETECTOR, SOURCE_TO_ISOCENTRE, PIXELS, PIXEL = 1020.0, 740.0, 448, 1.25
"""The paper's orbit: distances in mm, pixels along each side of the detector, and mm along each side of a pixel."""


def on_circle(angles: np.ndarray, source_to_detector: float, source_to_isocentre: float,
              pixel: tuple[float, float]) -> Poses:
    """Upright detectors at angles (K,) in radians about the superior axis; 0 is PA, at a right angle the source is at
    the patient's left. pixel: (row height, column width) in mm."""
    cos, sin = np.round(np.cos(angles), 15), np.round(np.sin(angles), 15)  # exact zeros at right angles
    zero = np.zeros_like(cos)
    towards = np.stack([sin, cos, zero], 1)
    return (-source_to_isocentre * towards, (source_to_detector - source_to_isocentre) * towards,
            pixel[1] * np.stack([-cos, sin, zero], 1), pixel[0] * np.stack([zero, zero, zero - 1], 1))


def on_line(tangents: np.ndarray, source_to_detector: float, source_to_isocentre: float,
            pixel: tuple[float, float]) -> Poses:
    """A resting PA detector, and sources on the line parallel to the superior axis, seen from the isocentre at angles
    from the PA view of these tangents (K,), superior ones positive."""
    one = np.ones((len(tangents), 1))
    sources = np.stack([0 * tangents, 0 * tangents - source_to_isocentre, source_to_isocentre * tangents], 1)
    return (sources, one * [0, source_to_detector - source_to_isocentre, 0], one * [-pixel[1], 0, 0],
            one * [0, 0, -pixel[0]])


def turned(poses: Poses, angle: float) -> Poses:
    """Each view turned about the line through the isocentre that its rows run along, so that its source rises by
    `angle`, in radians."""
    def about(axis: np.ndarray, vector: np.ndarray) -> np.ndarray:  # Rodrigues' rotation
        along = (axis * vector).sum(1, keepdims=True) * axis
        return np.cos(angle) * (vector - along) + np.sin(angle) * np.cross(axis, vector) + along

    sources, detectors, u, v = poses
    axis = u / np.linalg.norm(u, axis=1, keepdims=True)
    return about(axis, sources), about(axis, detectors), u, about(axis, v)
