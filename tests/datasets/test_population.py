"""Laws of populations: patients come back, shapes are taken over, nothing tears, findings are where reports say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
from processes import Python
from scipy import ndimage

from phydict.datasets import CTCases, Thorax, build, find_cts, without
from phydict.datasets.phantoms.findings import Finding
from phydict.datasets.population import Anatomy, DrawnPatients, Population, PopulationSettings, Variation
from phydict.datasets.population.carry import carry
from phydict.datasets.population.findings import put_findings
from phydict.datasets.population.organs import expansion
from phydict.datasets.population.registration import overlap
from phydict.datasets.population.velocity import flow, jacobian, places, resize, sample
from phydict.datasets.surroundings.couches import Couch
from phydict.grid import Cube, Grid
from phydict.training.crops import SuperResolutionData
from phydict.training.data import PriorData
from phydict.training.draws import MixedCases
from phydict.training.settings import HoldOut, Loading
from phydict.units import HUWindow

GRID, WINDOW, ROOT = Grid.cube(32), HUWindow(), Path(__file__).parents[2]
FLAT = Couch(width=420.0, thickness=40.0, gap=10.0, shift=0.0, curve=0.0, keel=0.0, pad=0.0, pad_hu=-900.0, shell=3.0,
             shell_hu=0.0, core_hu=-950.0)
STRONG = Variation(mixing=1.0, modes=2.0, lungs=0.7, heart=0.7, liver=0.7, findings=0.0)


def thorax(seed: int, **changes) -> Thorax:
    """A healthy thorax scanned as a whole, on a flat couch, with raised arms."""
    return replace(without(Thorax.draw(seed)), noise=4.0, scan=(-400.0, 400.0), field=470.0, couch=FLAT,
                   arms=(True, True), **changes)


def write_ct(file: Path, hu: np.ndarray, mm: float) -> None:
    image = nibabel.Nifti1Image(hu.astype(np.int16), np.diag([mm, mm, mm, 1.0]))
    image.set_sform(image.affine, code=1)
    nibabel.save(image, file)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three thoraxes as CTs: a wide, a narrow and a small one."""
    folder = tmp_path_factory.mktemp("cts")
    sizes = ({"width": 145.0, "height": 250.0}, {"width": 124.0, "height": 275.0}, {"width": 128.0, "height": 228.0})
    for n, size in enumerate(sizes):
        write_ct(folder / f"patient{n}.nii.gz", build(thorax(n + 20, **size), Grid.cube(56, 448.0))[0], 8.0)
    return folder


@pytest.fixture(scope="module")
def drawn(folder, tmp_path_factory) -> DrawnPatients:
    cache = tmp_path_factory.mktemp("cache")
    drawn = DrawnPatients(CTCases(find_cts(folder), cache, GRID), PopulationSettings(0.5, draws=4))
    drawn.prepare()
    return drawn


@pytest.fixture(scope="module")
def population(drawn) -> Population:
    return drawn.population


@pytest.fixture(scope="module")
def coarse(tmp_path_factory) -> Path:
    """A cache in which two patients on coarse voxels are registered once."""
    return tmp_path_factory.mktemp("coarse")


def rmse(a: dict, b: dict) -> float:
    return WINDOW.half_width * float((a["volume"] - b["volume"]).square().mean().sqrt())


def test_of_three_patients_each_is_registered_and_one_is_the_template(population):
    assert len(population.cases) == 3 and not population.velocities[population.template].any()
    assert sum(bool(velocity.any()) for velocity in population.velocities) == 2


@pytest.mark.parametrize("patient", range(3))
def test_without_any_change_a_patient_comes_back(population, patient):
    case, same = population.cases[patient], Anatomy.of(patient, 3)
    assert population.case(same)["volume"].equal(case["volume"])
    there_and_back = carry(case, population.sources(same), GRID, WINDOW)
    assert rmse(there_and_back, case) < 25 and overlap(there_and_back["masks"][0], case["masks"][0]) > 0.98


@pytest.mark.parametrize("patient, other", [(0, 1), (1, 2), (2, 0)])
def test_with_all_weight_on_another_patient_a_ct_takes_their_shape(population, patient, other):
    of_other = population.cases[other]["masks"][0]
    shaped = population.case(Anatomy(patient, Anatomy.of(other, 3).weights))
    before = overlap(population.cases[patient]["masks"][0], of_other)
    after = overlap(shaped["masks"][0], of_other)
    assert after > 0.88 and 1 - after < 0.6 * (1 - before)


@pytest.mark.parametrize("seed", range(6))
def test_whatever_is_drawn_does_not_tear(population, seed):
    anatomy = population.draw(seed, STRONG)
    assert sum(anatomy.weights) == pytest.approx(1)
    assert float(jacobian(population.sources(anatomy)).min()) > 0.1


def test_the_inverse_of_a_flow_is_the_flow_back(population):
    velocity = resize(population.velocity(population.draw(3)), GRID.shape)
    there, start = flow(velocity), places(velocity.shape[1:])
    back = start + flow(-velocity)
    missed = (back + sample(there, back) - start).norm(dim=0)[3:-3, 3:-3, 3:-3] * 192
    assert missed.mean() < 0.5 and there.norm(dim=0).max() * 192 > 5


def test_a_seed_is_a_draw(population):
    variation = Variation()
    first, again, other = (population.draw(seed, variation) for seed in (5, 5, 6))
    assert first == again != other
    assert population.case(first, 5)["volume"].equal(population.case(again, 5)["volume"])
    assert rmse(population.case(first), population.case(other)) > 50


@pytest.mark.parametrize("seed", [0, 1])
def test_masks_move_with_the_volume(population, seed):
    case = population.case(population.draw(seed, Variation(findings=0.0)))
    hu, lung = WINDOW.to_hu(case["volume"][0]), case["masks"][0] > 0.95
    assert lung.sum() > 500 and hu[lung].quantile(0.9) < -500
    before = population.cases[population.draw(seed, Variation(findings=0.0)).patient]["masks"][0] > 0.95
    assert (before ^ lung).sum() > 50


@pytest.mark.parametrize("factor", [0.3, -0.3])
def test_an_organ_grows_by_the_factor_that_its_velocity_says(factor):
    organ = (places((24, 24, 24)).norm(dim=0) < 0.45).float()
    velocity = factor * expansion(organ, (384.0, 384.0, 384.0), (0.6, 0.8, 1.6))
    grown = sample(organ[None], places((24, 24, 24)) + flow(-velocity))
    assert float(grown.sum() / organ.sum()) == pytest.approx(np.exp(factor), rel=0.06)
    far = jacobian(places((24, 24, 24)) + flow(velocity))[:4]
    assert far.sub(1).abs().max() < 0.03


@pytest.mark.parametrize("factor", [0.25, -0.25])
def test_inflated_lungs_have_more_volume_and_their_tissue_keeps_its_mass(population, factor):
    own = Anatomy.of(0, 3)
    case, inflated = population.cases[0], population.case(replace(own, lungs=factor))

    def volume_and_density(case: dict) -> tuple[float, float]:
        inside = (case["masks"][0] > 0.99) & (case["masks"][2] < 0.01)
        return float(case["masks"][0].sum()), float(WINDOW.to_hu(case["volume"][0])[inside].median()) + 1000

    (volume, density), (new_volume, new_density) = volume_and_density(case), volume_and_density(inflated)
    assert abs(np.log(new_volume / volume) - factor) < 0.06 and abs(np.log(new_density / density) + factor) < 0.08


def test_a_table_stays_straight_and_follows_the_back(population):
    case = population.cases[0]
    hu = torch.full((1, 32, 32, 32), -1000.0)
    hu[:, 8:24, 10:24] = 40.0
    hu[:, 4:28, 5:7] = -100.0
    bent = places(GRID.shape)
    bent[1] += 0.125 + 0.05 * torch.sin(4 * bent[2]) * (bent[0] ** 2)  # two voxels backwards, and bent
    moved = carry(case | {"volume": WINDOW.to_range(hu)}, bent, GRID, WINDOW)
    row = WINDOW.to_hu(moved["volume"][0])[5]
    assert (row[3:5] > -200).all() and (row[5:8] < -900).all() and (row[:2] < -900).all()


def place_of(change: np.ndarray) -> np.ndarray:
    """Mean world position in mm of what changed."""
    return (np.argwhere(change).mean(0) - 15.5) * 12


@pytest.mark.parametrize("kind, size", [("nodule", 28.0), ("mass", 50.0), ("consolidation", 0.6)])
@pytest.mark.parametrize("side", ["right", "left"])
def test_a_focal_finding_changes_its_lobe_and_nothing_else(population, kind, size, side):
    case, places_z = population.cases[1], {}
    hu, masks = WINDOW.to_hu(case["volume"][0]).numpy(), case["masks"].numpy()
    for lobe in ("upper", "lower"):
        changed, _, put = put_findings(hu, masks, GRID, (Finding(kind, side, lobe, size, 3),), False, 7)
        change = np.abs(changed - hu) > 30
        centre = place_of(change)
        assert len(put) == 1 and (changed - hu)[change].min() > 0
        assert (centre[0] > 20) == (side == "right") and abs(centre[0]) > 20
        across = (np.argwhere(change)[:, 0] - 15.5) * 12 * (1 if side == "right" else -1)
        assert across.min() > -13 and not change[masks[0] == 0].any()
        places_z[lobe] = centre[2]
    assert places_z["upper"] > places_z["lower"] + 20


@pytest.mark.parametrize("side", ["right", "left"])
def test_an_effusion_takes_its_share_of_one_lung_lies_at_the_back_and_is_no_longer_lung(population, side):
    case, own = population.cases[1], slice(16, None) if side == "right" else slice(None, 16)
    hu, masks = WINDOW.to_hu(case["volume"][0]).numpy(), case["masks"].numpy()
    changed, after, _ = put_findings(hu, masks, GRID, (Finding("effusion", side, "", 0.25, 3),), False, 7)
    lost = (masks[0] - after[0])
    assert lost[own].sum() / masks[0][own].sum() == pytest.approx(0.25, abs=0.08)
    assert lost.sum() == pytest.approx(lost[own].sum(), rel=0.03)
    fluid = lost > 0.9
    assert abs(np.median(changed[fluid]) - 10) < 15
    lung = ndimage.center_of_mass(masks[0][own])
    assert ndimage.center_of_mass(fluid[own])[1] < lung[1] - 1
    assert not (np.abs(changed - hu) > 1)[masks[0] == 0].any()


def test_the_report_of_a_draw_names_what_was_put_in(population):
    finding = Finding("effusion", "left", "", 0.25, 3)
    case = population.case(replace(Anatomy.of(0, 3), findings=(finding,)), 4)
    assert "left" in case["report"].lower() and "effusion" in case["report"].lower()
    assert population.case(Anatomy.of(0, 3), 4)["report"] == ""


def test_a_patient_with_a_report_keeps_it_and_gets_no_findings(population):
    told = Population([case | {"report": "Findings: mine."} for case in population.cases], population.velocities,
                      population.template, GRID, WINDOW)
    anatomies = [told.draw(seed, Variation(findings=1.0)) for seed in range(4)]
    assert not any(anatomy.findings for anatomy in anatomies)
    assert told.case(anatomies[0])["report"] == "Findings: mine."


def test_a_cached_draw_is_the_draw_and_other_variations_are_other_files(drawn, monkeypatch):
    first = drawn[1]
    monkeypatch.setattr(drawn.population, "case", None)
    again = drawn[1]
    assert again["volume"].equal(first["volume"]) and again["report"] == first["report"]
    other = DrawnPatients(drawn.cts, replace(drawn.settings, variation=Variation.none()))
    other.prepare()
    assert other.drawn != drawn.drawn
    patient = other.population.cases[other.population.draw(1, Variation.none()).patient]
    assert other[1]["volume"].sub(patient["volume"]).abs().max() < 1e-3


def test_further_scans_of_a_patient_are_left_out_and_it_is_said(drawn, capsys):
    first, second, *_ = drawn.cts.cts
    ids = ["a__1", "a__2", "b__1"]
    named = CTCases([replace(ct, id=id) for ct, id in zip((first, first, second), ids)], None, GRID)
    assert [ct.id for ct in DrawnPatients(named, drawn.settings).cts.cts] == ["a__1", "b__1"]
    assert "one scan of each of 2 patients, of 3 CTs" in capsys.readouterr().err


def test_a_stored_draw_is_not_that_of_the_same_patients_with_other_reports(drawn):
    told = CTCases([replace(ct, report="Findings: mine.") for ct in drawn.cts.cts], drawn.cts.cache, GRID)
    with_reports = DrawnPatients(told, drawn.settings)
    assert {drawn[seed]["report"] for seed in range(2)} != {"Findings: mine."}
    assert {with_reports[seed]["report"] for seed in range(2)} == {"Findings: mine."}


@pytest.mark.slow
def test_two_processes_share_a_cache(folder, tmp_path):
    code = """if True:
        import sys
        from phydict.datasets import CTCases, find_cts
        from phydict.datasets.population import DrawnPatients, PopulationSettings
        from phydict.grid import Grid
        cts = CTCases(find_cts(sys.argv[1])[:2], sys.argv[2], Grid.cube(16))
        drawn = DrawnPatients(cts, PopulationSettings(1.0, draws=3))
        print([round(float(drawn[i]["volume"].double().sum()), 6) for i in range(3)])"""
    runs = [Python(code, folder, tmp_path) for _ in range(2)]
    assert all(run.wait() == 0 for run in runs), [run.err for run in runs]
    third = DrawnPatients(CTCases(find_cts(folder)[:2], tmp_path, Grid.cube(16)), PopulationSettings(1.0, draws=3))
    sums = [round(float(third[i]["volume"].double().sum()), 6) for i in range(3)]
    assert [run.out.strip() for run in runs] == [str(sums)] * 2
    assert not list(tmp_path.rglob("*.part.*")) and len(list(third.drawn.iterdir())) == 3


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_draws_from_cts_comes_from_the_population(drawn, share):
    settled = DrawnPatients(drawn.cts, replace(drawn.settings, share=share))
    cts, phantoms = [None] * 3, [None] * 2
    draws = MixedCases(cts, phantoms, 0.6, GRID, WINDOW, 400, 0, 0, population=settled)
    picked = [draws.source(np.random.default_rng(i)) for i in range(400)]
    counts = [sum(source is of for source in picked) / 400 for of in (phantoms, cts, settled)]
    assert counts == pytest.approx([0.4, 0.6 * (1 - share), 0.6 * share], abs=0.08)
    plain = MixedCases(cts, phantoms, 0.6, GRID, WINDOW, 400, 0, 0)
    assert all((plain.source(np.random.default_rng(i)) is phantoms) == (picked[i] is phantoms) for i in range(400))


def test_training_draws_from_the_population_what_it_draws_from_the_folder(folder, coarse):
    settings = PopulationSettings(1.0, draws=2, variation=Variation(findings=1.0))
    data = PriorData(str(folder), holdout=HoldOut(["patient2"], phantoms=0), phantoms=0, cache=str(coarse),
                     loading=Loading(epoch_size=2, population=settings), cube=Cube(16))
    item = data.draws(0)[0]
    assert {case["id"] for case in data.population.population.cases} == {"patient0", "patient1"}
    assert item["volume"].shape == (1, 16, 16, 16) and item["report"].startswith("Findings:")
    assert data.reports and all(isinstance(report, str) for report in data.reports)


def test_a_super_resolution_stage_refuses_a_population(folder, tmp_path):
    with pytest.raises(ValueError, match=r"population\.share is 0\.5: set it to 0"):
        SuperResolutionData(cts=str(folder), cache=str(tmp_path), cube=Cube(96),
                            loading=Loading(population=PopulationSettings(0.5)))


def water(folder: Path) -> None:
    """Adds a CT without lungs."""
    hu = np.full((20, 20, 20), -1000.0)
    hu[4:16, 6:15] = 40
    write_ct(folder / "water.nii.gz", hu, 20.0)


def test_a_ct_that_does_not_register_is_named_and_left_out(folder, coarse, tmp_path):
    cts = tmp_path / "cts"
    cts.mkdir()
    for n in range(2):
        (cts / f"patient{n}.nii.gz").symlink_to(folder / f"patient{n}.nii.gz")
    water(cts)
    drawn = DrawnPatients(CTCases(find_cts(cts), coarse, Grid.cube(16)))
    with pytest.warns(UserWarning, match=r"the CT water does not register \(no lungs were found in it\)"):
        drawn.prepare()
    assert [case["id"] for case in drawn.population.cases] == ["patient0", "patient1"]


def test_fewer_than_two_patients_are_refused(folder, coarse, tmp_path):
    files = find_cts(folder)
    with pytest.raises(ValueError, match=r"at least 2 patients, but there is 1 to train on \(patient0\)"):
        DrawnPatients(CTCases(files[:1], None, GRID))
    with pytest.raises(ValueError, match="; 3 CTs in the subfolder scans count as one patient's, give that folder"):
        DrawnPatients(CTCases([replace(ct, id=f"scans__{ct.id}") for ct in files], None, GRID))
    with pytest.raises(ValueError, match=r"1 to train on \(train_1_a_0\): give more CTs"):
        DrawnPatients(CTCases([replace(ct, id=f"train_1_a_{n}") for n, ct in enumerate(files)], None, GRID))
    water(tmp_path)
    drawn = DrawnPatients(CTCases([files[0], *find_cts(tmp_path)], coarse, Grid.cube(16)))
    with pytest.warns(UserWarning, match="water"), pytest.raises(ValueError, match="1 of 2 could be registered"):
        drawn.prepare()


@pytest.mark.parametrize("settings, words", [
    (lambda: PopulationSettings(1.5), "share lies between"),
    (lambda: PopulationSettings(0.5, draws=0), "draws lies between"),
    (lambda: PopulationSettings(0.5, patients=1), "patients lies between"),
    (lambda: Variation(lungs=2.0), "variation.lungs lies between"), (lambda: Variation(modes=-1.0), "variation.modes")])
def test_settings_that_cannot_be_are_refused_by_their_name(settings, words):
    with pytest.raises(ValueError, match=words):
        settings()
