"""Procedural chest CT: a seed gives a thorax, the thorax gives volume, masks and the report that describes them.

    seed --Thorax.draw--> parameters --build--> HU volume + lung, airway, vessel masks
                                     --report--> text

The anatomy lives in world mm, so one thorax can be built on any grid. Later structures are painted over earlier ones
with their partial volume, edges one voxel wide.
"""

from __future__ import annotations

import numpy as np
import scipy
import torch

from phydict.datasets.case import Case
from phydict.datasets.phantoms.canvas import Canvas, Texture
from phydict.datasets.phantoms.lungs import airways, focal_findings, lung_tissue, pleural_space, vessels
from phydict.datasets.phantoms.skeleton import arm_end, bones
from phydict.datasets.phantoms.thorax import SIDES, Thorax, ellipsoid, report, smooth_max, superellipse, without
from phydict.grid import Grid
from phydict.units import AIR, HUWindow

NOISE_MM = 1.5
"""Voxels to which `Thorax.noise` refers; larger ones average it, as noise that neighbours share in part."""


def build(thorax: Thorax, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The thorax on `grid`: HU (X, Y, Z) float32, and masks (3, X, Y, Z) of lung, airway, vessel in [0, 1].

    The masks are shares of a voxel: lung is the aerated or consolidated lung with its vessels, airway the air in
    trachea and bronchi, vessel the vessels inside the lungs.
    """
    canvas = Canvas(thorax, grid)
    texture = Texture(thorax.seed, 0, 16.0)(*canvas.axes)
    body = _trunk(canvas, texture)
    cavity = np.maximum(*(canvas.soft(thorax.lung(side, *canvas.axes)) for side in SIDES))
    tissue = lung_tissue(canvas, texture)
    vessel = vessels(canvas, tissue)
    focal_findings(canvas, tissue, texture)
    pleural = pleural_space(canvas, tissue)
    canvas.paint(cavity, tissue)
    lung = cavity * (1 - pleural)
    vessel = vessel * lung
    _abdomen(canvas, texture)
    organs = _mediastinum(canvas)
    lung, vessel = lung * (1 - organs), vessel * (1 - organs)
    _skeleton(canvas, texture)
    airway = airways(canvas, pleural)
    lung = lung * (1 - airway)
    masks = np.stack([lung, airway, np.minimum(vessel, lung)])
    _couch(canvas, body)
    _scanner(canvas, masks)
    return canvas.hu, np.clip(masks, 0, 1).astype(np.float32)


def _trunk(canvas: Canvas, texture: np.ndarray) -> np.ndarray:
    """Skin, fat, muscle, breasts, arms and neck, and the fat that fills the rib cage; returns the body's share."""
    t, (x, y, z) = canvas.thorax, canvas.axes
    muscle = t.muscle(x, y, z)
    neck_y = y + 0.28 * t.depth
    muscle = -smooth_max(-muscle, -np.maximum(superellipse(x, neck_y, 56, 56, 2.2), (0.3 * t.height - z)), 30.0)
    for s in SIDES.values():
        start = np.array([s * (t.width + t.wall + 6), -18, 0.5 * t.height - 25])
        line = arm_end(t, s) - start
        along = np.clip(((x - start[0]) * line[0] + (y - start[1]) * line[1] + (z - start[2]) * line[2])
                        / (line @ line), 0, 1)
        arm = np.sqrt((x - start[0] - along * line[0]) ** 2 + (y - start[1] - along * line[1]) ** 2
                      + (z - start[2] - along * line[2]) ** 2) - t.arm_width
        muscle = -smooth_max(-muscle, -arm, 25.0)
    front = np.clip(y / t.depth, -1, 1)
    lumps = 0.15 * min(t.fat, 25) * np.clip(Texture(t.seed, 12, 60.0)(x, y, z), -2, 2)
    skin = muscle - t.fat * (0.85 + 0.25 * np.clip(-t.level(z) + 0.6, -0.6, 0.6) - 0.15 * front) - lumps - 2
    skin = smooth_max(skin, -canvas.straight_y - t.back_plane, 16.0)
    if t.breast:
        bulge = np.array([62, 34, 55]) * t.breast
        centre = [0.55 * t.width, 0.85 * t.depth, -0.02 * t.height]
        breast = ellipsoid(np.abs(x), y, z, centre, np.eye(3), bulge)
        skin = -smooth_max(-skin, -breast, 15.0)
    canvas.paint(canvas.soft(skin), -103 + 3 * texture)
    canvas.paint(canvas.soft(skin) - canvas.soft(skin + 1.6), 20.0)
    if t.breast:
        gland = canvas.soft(breast + 14) * np.clip(0.4 + 0.5 * texture, 0, 1)
        canvas.paint(gland, 20.0)
    streaks = t.marbling * (1 + 0.4 * np.clip(2 * t.level(z) - 1, 0, 1)) * np.clip((texture + 0.2) * 0.45, 0, 0.9)
    canvas.paint(canvas.soft(muscle), np.maximum(t.muscle_hu - 155 * streaks, -100))
    cage = t.cage(x, y, z)
    roof = z - 0.5 * t.height
    inside = canvas.soft(smooth_max(cage - 2, roof, 10.0))
    canvas.paint(inside, -85 + 45 * np.clip(texture, -1, 2.2))
    return canvas.soft(skin)


def _abdomen(canvas: Canvas, texture: np.ndarray) -> None:
    """Liver, stomach with gas, spleen, kidneys and bowel below the diaphragm."""
    t = canvas.thorax
    enhanced = 60.0 if t.contrast else 0.0
    box, (x, y, z) = canvas.box([-1.1 * t.width, -1.2 * t.depth, -600], [1.1 * t.width, 1.2 * t.depth, 0])
    if 0 in canvas.hu[box].shape:
        return
    floor = t.diaphragm(x, y)
    room = smooth_max(t.cage(x, y, z) + 3, (z - floor + 4) * 0.8, 8.0)
    room = np.maximum(room, t.spine + 12 - np.hypot(x, y - t.spine_y(z) + 4))
    base = -0.5 * t.height + t.dome
    content = texture[box]
    left_edge = 7 * content - (x + 45) + 0.5 * np.clip(base - z, 0, 120) - 0.35 * np.clip(y, -80, 80)
    lower = base - 135 - 0.55 * x - z
    liver = smooth_max(room, smooth_max(left_edge * 0.75, lower * 0.85, 15.0), 12.0)
    fundus = np.array([-0.42 * t.width, 0.1 * t.depth, base - 42])
    stomach = np.maximum(ellipsoid(x, y, z, fundus, np.eye(3), np.array([38, 44, 48.0])), room)
    spleen = np.maximum(ellipsoid(x, y, z, [-0.68 * t.width, -0.5 * t.depth, base - 62], np.eye(3),
                                  np.array([30, 40, 52.0])), room)
    canvas.paint(canvas.soft(room + 3) * 0.9, 5 + enhanced / 3 - 90 * np.clip(content, -0.8, 1.1), box)
    canvas.paint(canvas.soft(stomach), 35 + 8 * content, box)
    level = fundus[1] + 44 * (0.95 - 1.3 * t.gas)
    canvas.paint(canvas.soft(np.maximum(stomach + 3, level - y)), AIR + 40, box)
    canvas.paint(canvas.soft(spleen), 48 + enhanced + 2 * content, box)
    canvas.paint(canvas.soft(liver), t.liver_hu + 3 * content, box)
    for s in (1, -1):
        kidney, share = canvas.blob([s * 52, t.spine_y(0) + 8, base - 128 - 8 * s], [24, 24, 52])
        canvas.paint(share, 32 + 2 * enhanced, kidney)
    rng = np.random.default_rng([t.seed, 8])
    for _ in range(9):
        centre = [rng.uniform(-0.7, 0.5) * t.width, rng.uniform(-0.1, 0.8) * t.depth, base - rng.uniform(100, 260)]
        loop, share = canvas.blob(centre, rng.uniform(11, 22, 3))
        canvas.paint(share * 0.9, -700.0 if rng.random() < 0.3 else 30.0, loop)


def _mediastinum(canvas: Canvas) -> np.ndarray:
    """Heart, great vessels and oesophagus; returns their share."""
    t, organs = canvas.thorax, np.zeros(canvas.grid.shape, np.float32)
    right_blood, left_blood = t.blood
    ratio = next((f.size for f in t.findings if f.kind == "cardiomegaly"), t.heart)
    centre, axes, half = t.heart_ellipsoid(ratio)
    reach = np.sqrt(((axes * half[:, None]) ** 2).sum(0))

    def put(box, share, value, covers=True):
        canvas.paint(share, value, box)
        if covers:
            organs[box] = np.maximum(organs[box], share)

    for finding in t.findings:
        if finding.kind == "pericardial effusion":
            put(*canvas.blob(centre, half + finding.size, axes), 12.0)
    put(*canvas.blob(centre, half, axes), -60.0)
    put(*canvas.blob(centre, half - 2.0, axes), 48 + (45 if t.contrast else 0))
    chambers = [((-0.36, -0.10, -0.08), 0.42, left_blood), ((0.08, 0.40, -0.12), 0.38, right_blood),
                ((0.58, 0.05, 0.05), 0.36, right_blood), ((0.15, -0.52, 0.30), 0.38, left_blood)]
    for place, size, blood in chambers:
        put(*canvas.blob(centre + reach * place, reach * size), blood, False)
    c, spine = t.carina, t.spine_y(t.carina)
    back = float(spine) + t.spine * 0.8
    low = float(t.spine_y(-0.4 * t.height)) + t.spine * 0.8
    arch = [[0, 6, c - 58], [11, 13, c - 28], [13, 10, c], [7, 1, c + 22], [-7, -14, c + 30], [-19, -28, c + 21],
            [-23, back + 3, c], [-22, back + 2, c - 60], [-14, low + 13, -0.42 * t.height],
            [-8, low + 15, -0.55 * t.height], [-8, low + 15, -2.0 * t.height]]
    lungs = [[[-15, 24, c - 55], [-18, 8, c - 26], [-36, -12, c - 16], [-48, -19, c - 24]],
             [[-15, 6, c - 26], [10, -6, c - 27], [46, -14, c - 32]]]
    for path in lungs:
        put(*canvas.pipe(path, [t.aorta * 0.85] * (len(path) - 1) + [7]), right_blood)
    cava = [[25, 10, c + 40], [27, 8, c - 10], [25, 6, c - 55]]
    put(*canvas.pipe(cava, 9), t.cava)
    brachiocephalic = [[40, 8, c + 80], [25, 10, c + 42], [-8, 22, c + 54], [-45, 6, c + 84]]
    put(*canvas.pipe(brachiocephalic, 7), 0.5 * (t.cava + right_blood))
    put(*canvas.pipe([[-4, back + 12, c + 140], [-4, back + 12, c], [-2, low + 20, -0.4 * t.height]], 7), 32.0)
    taper = np.array([1.05, 1.1, 1.08, 1.0, 0.95, 0.92, 0.9, 0.86, 0.82, 0.78, 0.7])
    put(*canvas.pipe(arch, t.aorta * taper), left_blood)
    for path in ([[10, -4, c + 20], [17, -8, c + 60], [30, -14, c + 150]], [[-14, -22, c + 24], [-30, -22, c + 150]]):
        put(*canvas.pipe(path, 5.5), left_blood)
    put(*canvas.pipe([[22, 8, centre[2] - reach[2] * 0.5], [24, 0, -0.9 * t.height]], 11), 0.5 * sum(t.blood), False)
    return organs


def _skeleton(canvas: Canvas, texture: np.ndarray) -> None:
    """Vertebral bodies with discs and canal, then all other bones."""
    t = canvas.thorax
    span = 2 * t.spine
    back = float(t.spine_y(0))
    box, (x, y, z) = canvas.box([-span, back - 4 * t.spine, -700], [span, back + span + 45, 700])
    if 0 not in canvas.hu[box].shape:
        y = y - t.spine_y(z)
        body = superellipse(x, y, t.spine, 0.8 * t.spine, 2.4) + 0 * z
        phase = np.abs((z - 0.5 * t.height + 4) / t.vertebra - np.rint((z - 0.5 * t.height + 4) / t.vertebra))
        disc = (0.5 - phase) * t.vertebra - 2.6
        muscles = superellipse(np.abs(x) - 26, y + 0.8 * t.spine + 26, 24, 20, 2.2) + 0 * z
        canvas.paint(canvas.soft(muscles) * 0.9, t.muscle_hu - 5, box)
        canvas.paint(canvas.soft(body), 95.0, box)
        inside = canvas.soft(np.maximum(body, -disc))
        canvas.paint(inside, t.bone + 30 * texture[box], box)
        rim = (canvas.sheet(body + 1, 2.2) * canvas.soft(-disc) + canvas.sheet(disc - 1, 2.0) * canvas.soft(body))
        canvas.paint(np.minimum(rim, 1) * 0.7, 0.45 * t.cortex, box)
    share, value = canvas.fill(bones(t))
    canvas.paint(share, value)
    if 0 not in canvas.hu[box].shape:
        canvas.paint(canvas.soft(np.hypot(x, y + 0.8 * t.spine + 9) - 8 + 0 * z), 28.0, box)


def _couch(canvas: Canvas, body: np.ndarray) -> None:
    """What the patient lies on, outside the body; its cross-section is drawn finely, averaged over a voxel, sampled."""
    t = canvas.thorax
    if t.couch is None:
        return
    step = canvas.edge / 5
    across, up = np.arange(-350, 350, step), np.arange(-320, 200, step)
    section = scipy.ndimage.uniform_filter(t.couch.section(across, up), 5)
    places = np.stack(np.broadcast_arrays(canvas.axes[0] - across[0], canvas.straight_y + t.back_plane - up[0])) / step
    density = scipy.ndimage.map_coordinates(section, places, order=1).astype(np.float32)
    canvas.hu += 1000 * (1 - body) * np.clip(-canvas.hu / 1000, 0, 1) * density


def _scanner(canvas: Canvas, masks: np.ndarray) -> None:
    """Noise, and air outside the field of view and the scanned range."""
    t = canvas.thorax
    if t.noise:
        grain = np.random.default_rng([t.seed, 9]).standard_normal(canvas.grid.shape, np.float32)
        averaged = min(1.0, NOISE_MM / canvas.edge)
        canvas.hu += np.float32(2.4 * t.noise * averaged) * scipy.ndimage.gaussian_filter(grain, (0.6, 0.6, 0.9))
        slow = Texture(t.seed, 10, 13.0)(*canvas.axes)
        canvas.hu += np.float32(0.3 * t.noise) * slow * np.clip((canvas.hu - AIR) / 1000, 0, 1)
        unresolved = t.noise * np.sqrt(max(1 - averaged**2, 1e-6))
        above = (canvas.hu - AIR) / unresolved
        density = np.exp(-above * above / 2) / np.sqrt(2 * np.pi)
        canvas.hu = AIR + unresolved * (above * scipy.special.ndtr(above) + density)
    world = [axis + offset for axis, offset in zip((canvas.axes[0], canvas.straight_y, canvas.axes[2]), t.offset)]
    across = np.hypot(world[0], world[1]) if t.round_field else np.maximum(np.abs(world[0]), np.abs(world[1]))
    scanned = canvas.soft(across - t.field / 2) * canvas.soft(np.maximum(t.scan[0] - world[2], world[2] - t.scan[1]))
    canvas.hu = np.maximum(AIR + scanned * (canvas.hu - AIR), AIR).astype(np.float32)
    masks *= scanned


def pathology_region(thorax: Thorax, grid: Grid, threshold: float = 30.0) -> np.ndarray:
    """Voxels (X, Y, Z) bool that the findings change by more than `threshold` HU, noise being equal."""
    return np.abs(change_by_findings(thorax, grid)) > threshold


def change_by_findings(thorax: Thorax, grid: Grid) -> np.ndarray:
    """HU (X, Y, Z) that the findings add to the same thorax without them, noise being equal."""
    return build(thorax, grid)[0] - build(without(thorax), grid)[0]


def phantom_case(seed: int, grid: Grid | None = None, window: HUWindow = HUWindow()) -> Case:
    """The Case of one seed: id, volume (1, X, Y, Z) in the prior's range, masks (3, X, Y, Z), has_masks (3,), report.

    `grid` defaults to 64^3 voxels of 6 mm. The same seed, grid and window give the same bits.
    """
    thorax = Thorax.draw(seed)
    hu, masks = build(thorax, Grid.cube(64) if grid is None else grid)
    return {"id": f"phantom-{seed:06d}", "volume": torch.from_numpy(window.to_range(hu)[None]).float(),
            "masks": torch.from_numpy(masks), "has_masks": torch.ones(3, dtype=torch.bool), "report": report(thorax)}
