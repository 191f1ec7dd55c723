"""Lung, airway and vessel masks of a chest CT by thresholds and connected components, without a network.

    interior air   HU < -320, not joined to the sides of the field of view within its axial slice
    lungs          interior air components of lung size inside the body that are not pure gas, without the airway,
                   closed by 8 mm
    airway         region growing from the trachea below -700 HU, stepped down to -940 HU until it does not leak
    vessels        HU > -500 inside the closed lungs, 3 mm away from their surface

-320 HU as the lung threshold follows the Hounsfield histogram's valley between lung and soft tissue
(Hu, Hoffman, Reinhardt 2001, doi:10.1109/42.929615). Known limits: consolidations and nodules away from the pleura
count as vessels, masses at the pleura are left out of the lungs, the airway ends at the segmental bronchi, and a lung
that the field of view cuts open sideways is lost in those slices.
"""

from __future__ import annotations

import numpy as np
import scipy

MASKS = ("lung", "airway", "vessel")
LUNG_BELOW, VESSEL_ABOVE = -320.0, -500.0
AIRWAY_BELOW, TRACHEA_BELOW, GAS_MEDIAN = (-700.0, -740.0, -780.0, -820.0, -860.0, -900.0, -940.0), -900.0, -970.0
LUNG_LITRES, AIRWAY_LITRES = 0.15, 0.1
CLOSING_MM, SURFACE_MM, AXIS_MM = 8.0, 3.0, 45.0
TRACHEA_MM2 = (50.0, 800.0)
BODY_RIM = 2
"""Voxels by which `_body` is widened before its holes are filled."""
IN_PLANE = np.array([[[0], [1], [0]], [[1], [1], [1]], [[0], [1], [0]]], bool) & [False, True, False]


def segment(hu: np.ndarray, spacing) -> tuple[np.ndarray, np.ndarray]:
    """Masks of lung, airway and vessels, and which of them are known.

    hu: (X, Y, Z) Hounsfield units in RAS+ order, at 1 to 3 mm for good results. spacing: (x, y, z) mm.
    Returns masks (3, X, Y, Z) float32 of 0 and 1 (the lung includes its vessels, not the airway), and known (3,) bool:
    all False with zero masks where no lungs are found, the airway alone False where no trachea is found.
    """
    spacing = np.broadcast_to(np.asarray(spacing, float), 3)
    masks, known = np.zeros((3, *hu.shape), np.float32), np.zeros(3, bool)
    interior = _without_border(hu < LUNG_BELOW) & _body(hu, spacing)
    lungs = _lung_components(interior, hu, spacing)
    if not lungs.any():
        return masks, known
    box = _box(lungs, np.ceil(2 * CLOSING_MM / spacing).astype(int))
    box = (*box[:2], slice(box[2].start, hu.shape[2]))  # the trachea continues above the lungs
    hu, lungs = hu[box], lungs[box]
    airway = _airway(interior[box], lungs, hu, spacing)
    filled, vessel = _fill(lungs, airway, hu, spacing)
    for mask, part in zip(masks, (filled, airway, vessel)):
        mask[box] = part
    known[:] = True, airway.any(), True
    return masks, known


def body_mask(hu: np.ndarray, spacing) -> np.ndarray:
    """The body without table and clothes, its lungs filled: (X, Y, Z) bool of `hu` (X, Y, Z) at `spacing` mm."""
    body = _body(hu, np.broadcast_to(np.asarray(spacing, float), 3))
    return scipy.ndimage.binary_erosion(body, IN_PLANE, iterations=BODY_RIM, border_value=1)


def lung_box_centre(lung: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """World position (3,) in mm of the centre of the box around the mask `lung` (X, Y, Z), which must not be empty."""
    middle = [(s.start + s.stop - 1) / 2 for s in _box(lung > 0.5, 0)]
    return affine[:3, :3] @ middle + affine[:3, 3]


def lung_box_size(lung: np.ndarray, spacing) -> np.ndarray:
    """Edge lengths (3,) in mm of the box around the mask `lung` (X, Y, Z), which must not be empty."""
    return np.array([s.stop - s.start for s in _box(lung > 0.5, 0)]) * spacing


def _without_border(air: np.ndarray) -> np.ndarray:
    """Air that is not joined to the sides (x and y faces) within its own axial slice."""
    labels, count = scipy.ndimage.label(air, IN_PLANE)
    outside = np.zeros(count + 1, bool)
    outside[0] = True
    for face in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        outside[face] = True
    return ~outside[labels]


def _body(hu: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """The largest piece of tissue, cut from the table by an opening of 4 mm, widened, its holes filled by slice; with
    the lungs that lie in it for the most part, and the walls beside them that the opening took away."""
    tissue, reach = hu > LUNG_BELOW, max(1, round(4 / spacing[:2].min()))
    labels, _ = scipy.ndimage.label(scipy.ndimage.binary_opening(tissue, IN_PLANE, iterations=reach))
    size = np.bincount(labels.ravel())
    size[0] = 0
    body = np.zeros(hu.shape, bool) if len(size) < 2 else labels == size.argmax()
    filled = _filled(body)
    labels, count = scipy.ndimage.label(_without_border(~tissue))
    whole, inside = (_litres(part, count, spacing) for part in (labels, labels[filled]))
    lungs = ((whole > LUNG_LITRES) & (inside > 0.5 * whole))[labels]
    if (lungs <= filled).all():
        return filled
    return _filled(body | lungs | tissue & scipy.ndimage.binary_dilation(lungs, IN_PLANE, iterations=2 * reach))


def _filled(body: np.ndarray) -> np.ndarray:
    """The body widened, and its holes filled by slice."""
    body = scipy.ndimage.binary_dilation(body, IN_PLANE, iterations=BODY_RIM)
    return body | _without_border(~body)


def _litres(labels: np.ndarray, count: int, spacing: np.ndarray) -> np.ndarray:
    """Volumes (count + 1,) of the labelled pieces; the background, label 0, has none."""
    litres = np.bincount(labels.ravel(), minlength=count + 1) * spacing.prod() / 1e6
    litres[0] = 0
    return litres


def _lung_components(interior: np.ndarray, hu: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Interior air components of lung size whose median is not that of pure gas (bowel, folds of the table)."""
    labels, count = scipy.ndimage.label(interior)
    litres = _litres(labels, count, spacing)
    keep = litres > max(LUNG_LITRES, 0.05 * litres.max())
    for label in np.flatnonzero(keep):
        keep[label] = np.median(hu[labels == label]) > GAS_MEDIAN
    return keep[labels]


def _airway(interior: np.ndarray, lungs: np.ndarray, hu: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """The trachea and bronchi grown from a tube of gas near the lungs' axis, or nothing where there is none."""
    seed = _trachea(interior, lungs, hu, spacing)
    for threshold in AIRWAY_BELOW if seed.any() else ():
        tree = scipy.ndimage.binary_propagation(seed, mask=(interior & (hu < threshold)) | seed)
        if tree.sum() * spacing.prod() / 1e6 < AIRWAY_LITRES:
            return scipy.ndimage.binary_closing(tree)
    return seed


def _trachea(interior: np.ndarray, lungs: np.ndarray, hu: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """The longest stack of trachea-sized gas discs near the lungs' axis, in and above their upper 40 %."""
    x, _, z = _box(lungs, 0)
    start = int(z.stop - 0.4 * (z.stop - z.start))
    gas = interior & (hu < TRACHEA_BELOW)
    gas[:, :, :start] = False
    labels, count = scipy.ndimage.label(gas, IN_PLANE)
    if not count:
        return gas
    index = np.arange(1, count + 1)
    area = np.bincount(labels.ravel(), minlength=count + 1)[1:] * spacing[0] * spacing[1]
    across = np.array(scipy.ndimage.center_of_mass(gas, labels, index))[:, 0]
    near = abs(across - (x.start + x.stop - 1) / 2) * spacing[0] < AXIS_MM
    disc = np.concatenate([[False], near & (area > TRACHEA_MM2[0]) & (area < TRACHEA_MM2[1])])
    stacks, count = scipy.ndimage.label(disc[labels])
    heights = [0.0] + [(s[2].stop - s[2].start) * spacing[2] for s in scipy.ndimage.find_objects(stacks)]
    return (stacks == int(np.argmax(heights))) & (max(heights) > 15)


def _fill(lungs: np.ndarray, airway: np.ndarray, hu: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lungs without the airway and its wall, closed over their vessels; and the vessels."""
    wall = scipy.ndimage.binary_dilation(airway, iterations=max(1, round(2 / spacing.min())))
    lungs = scipy.ndimage.binary_opening(lungs & ~wall)
    labels, _ = scipy.ndimage.label(lungs)
    size = np.bincount(labels.ravel())
    size[0] = 0
    lungs = (size > 0.02 * size.sum())[labels]
    closed = ~grown(~grown(lungs, spacing, CLOSING_MM), spacing, CLOSING_MM)
    filled = scipy.ndimage.binary_fill_holes(closed | lungs) & ~airway
    surface = grown(~(filled | airway), spacing, SURFACE_MM)
    return filled, filled & (hu > VESSEL_ABOVE) & ~surface


def grown(mask: np.ndarray, spacing: np.ndarray, reach: float) -> np.ndarray:
    """The mask and all voxels within `reach` mm of it, rod by rod of a ball: where that is a few voxels, in a tenth of
    the time of a distance transform."""
    most = (reach / spacing).astype(int)
    (x, y, z), (nx, ny, nz) = most, mask.shape
    padded = np.pad(mask, [(n, n) for n in most])
    rods = [padded[:, :, z:z + nz]]  # the mask grown by 0, 1, ... voxels along z
    for k in range(1, z + 1):
        rods.append(rods[-1] | padded[:, :, z - k:z - k + nz] | padded[:, :, z + k:z + k + nz])
    near = np.zeros_like(mask)
    for i, j in np.ndindex(2 * x + 1, 2 * y + 1):
        left = reach**2 - ((i - x) * spacing[0]) ** 2 - ((j - y) * spacing[1]) ** 2
        if left >= 0:
            near |= rods[min(z, int(np.sqrt(left) / spacing[2]))][i:i + nx, j:j + ny]
    return near


def _box(mask: np.ndarray, margin) -> tuple[slice, ...]:
    """The slices of the box around a mask, widened by `margin` voxels (a number or one per axis)."""
    margin = np.broadcast_to(margin, 3)
    ends = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {a})))[[0, -1]] for a in range(3)]
    return tuple(slice(max(0, int(low - m)), int(min(n, high + m + 1)))
                 for (low, high), m, n in zip(ends, margin, mask.shape))
