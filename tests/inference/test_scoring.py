"""The metrics of test and ablate: columns, tables, resumed runs, and what is refused before any work."""

from __future__ import annotations

import nibabel
import numpy as np
import pytest
import torch
import yaml
from command_lines import refusal
from evaluation.tiny_ct_clip import tiny
from nibabel.orientations import apply_orientation, inv_ornt_aff
from scipy.ndimage import gaussian_filter
from torch.nn import Identity

from inference.runs import ORBIT, phantoms, record, sirt, write_ct
from phydict.baselines import SIRT
from phydict.cli.infer import main
from phydict.datasets import CTSource, phantom_case
from phydict.datasets.cts.prepared import write_prepared
from phydict.datasets.cts.segmentations import organs_beside
from phydict.evaluation import backbones, perceptual, read_csv
from phydict.evaluation.fid import NAMES
from phydict.evaluation.organs import dice
from phydict.evaluation.planes import PLANES
from phydict.grid import Grid
from phydict.inference import scoring
from phydict.inference.data import ReconstructionData
from phydict.inference.page import results_page
from phydict.inference.results import FEATURES, CaseResults
from phydict.inference.scoring import FIDSettings, Scoring, segmented
from phydict.inference.summary import show_finished
from phydict.inference.voxels import Voxels, in_its_ct
from phydict.reconstruction import Reconstruction
from phydict.runtime.files import file_crc32
from phydict.runtime.lpips_networks import load_lpips
from phydict.units import HUWindow

METRICS = "--metrics=[lpips,fid,organs]"
COLUMNS = ("lpips_alex", "lpips_squeeze", "dice_lung", "hd95_lung", "cldice_vessel")

pytestmark = pytest.mark.usefixtures("without_plots")  # tests/ablation is of those


@pytest.fixture
def untrained(monkeypatch):
    for module in (perceptual, backbones):
        monkeypatch.setattr(module, "load_lpips", lambda backbone, *_: load_lpips(backbone, True))


def cases(folder, *more) -> list[str]:
    return phantoms(folder, 2, "--model.grid=34", METRICS, *more)


def test_test_measures_them_all_and_a_repeated_command_tables_the_same(tmp_path, untrained):
    main(cases(tmp_path, "--fid.replicates=20"))
    folder = tmp_path / "sirt"
    page, rows = (folder / "results.md").read_text(), read_csv(folder / "results.csv")
    assert all(not np.isnan(row[name]) for row in rows for name in COLUMNS if name != "hd95_lung" or row["dice_lung"])
    assert "Backbone squeezenet" in page and "2 cases with XY 68, YZ 68, ZX 68 slices" in page and "FID-YZ ↓" in page
    assert record(folder / "phantom-1000000")["settings"]["metrics"] == ["lpips", "fid", "organs"]
    (folder / "results.md").unlink()
    (folder / "results.csv").unlink()
    main(cases(tmp_path, "--fid.replicates=20"))
    assert (folder / "results.md").read_text() == page and read_csv(folder / "results.csv") == rows


def test_the_page_shows_the_frechet_distances_and_why_scores_are_empty(tmp_path, untrained):
    main(phantoms(tmp_path, 2, "--model.grid=34", "--metrics=[fid,clip]", "--fid.replicates=0"))
    page = (tmp_path / "index.html").read_text()
    assert "Frechet distance of slices (FID)" in page and "Backbone squeezenet" in page
    assert "CLIP T2I (%): empty, since CT-CLIP's checkpoint was not given" in page


@pytest.mark.parametrize("text, why", [(None, "CXR-BERT was not given"), (Identity(), "no case has a report")])
def test_volumes_are_scored_by_ct_clip_and_the_table_says_why_reports_are_not(text, why, cts, tmp_path, monkeypatch):
    model = tiny()
    model.text_transformer = text
    monkeypatch.setattr(scoring, "load_ct_clip", lambda *_: model)
    (tmp_path / "clip.pt").write_bytes(b"")
    main(sirt("test", tmp_path / "out", f"--data.cts={cts}", *ORBIT, "--metrics=[clip]",
              f"--clip.weights={tmp_path / 'clip.pt'}", "--model.grid.voxels=16", "--model.grid.side=96"))
    folder = tmp_path / "out" / "sirt"
    assert f"CLIP T2I (%): empty, since {why}" in (folder / "results.md").read_text()
    assert all(0 <= row["clip_i2i"] <= 100 and "clip_t2i" not in row for row in read_csv(folder / "results.csv"))


def test_a_text_tower_without_ct_clip_is_refused(tmp_path, capsys):
    given = phantoms(tmp_path, 1, "--metrics=[clip]", "--clip.text=there")
    assert "give clip.weights" in refusal(capsys, main, given)


def test_a_page_made_anew_has_the_frechet_distances_whose_features_are_kept(tmp_path, untrained):
    main(phantoms(tmp_path, 2, "--model.grid=34", "--metrics=[fid]"))
    made = (tmp_path / "index.html").read_text()
    main(["page", str(tmp_path)])
    assert "Frechet distance of slices (FID)" in made and (tmp_path / "index.html").read_text() == made
    (tmp_path / "sirt" / "phantom-1000000" / FEATURES).write_bytes(b"no features")
    with pytest.warns(UserWarning, match="left out of the Frechet distances: .*are missing or damaged"):
        results_page(tmp_path)
    assert "1 case with XY 34" in (tmp_path / "index.html").read_text()


def test_a_later_method_s_page_keeps_the_frechet_distances_of_those_before(tmp_path, untrained):
    main(phantoms(tmp_path, 1, "--model.grid=34", "--metrics=[fid]"))
    given = phantoms(tmp_path, 1, "--model.grid=34", "--metrics=[volume]")
    main([text.replace("sirt", "cgls") for text in given])
    assert "Frechet distance of slices (FID)" in (tmp_path / "index.html").read_text()


def test_the_page_of_a_stopped_run_says_how_frechet_distances_are_shown(tmp_path, untrained):
    main(phantoms(tmp_path, 1, "--model.grid=34", "--metrics=[fid]"))
    results = CaseResults(tmp_path / "sirt")
    held = record(tmp_path / "sirt" / "phantom-1000000")
    results.unfinished({"phantom-1000000": held["source"]}, held["settings"])
    show_finished(results, ["phantom-1000000", "another"], Scoring(["fid"]))
    page = (tmp_path / "index.html").read_text()
    assert "infer.py page \\u003cfolder>" in page and "(FID)" not in page


def test_other_metrics_do_not_pass_for_those_of_a_finished_case(tmp_path, capsys, untrained):
    main(phantoms(tmp_path, 1, "--model.grid=34"))
    other = phantoms(tmp_path, 1, "--model.grid=34", "--metrics=[lpips]")
    assert "other settings" in refusal(capsys, main, other)


def test_ablate_has_a_line_of_fid_for_each_method_and_resumes(tmp_path, untrained, capsys):
    file = tmp_path / "spec.yaml"
    file.write_text(yaml.safe_dump({
        "out": str(tmp_path / "out"), "phantoms": 2, "metrics": ["fid", "lpips"], "fid": {"replicates": 0},
        "base": {"voxels": 34, "detector": 24, "views": 3, "method.iterations": 2},
        "axes": {"method": ["sirt", "tv"]}}))
    args = ["ablate", "-c", str(file), "--device", "cpu"]
    main(args)
    page = (tmp_path / "out" / "tables.md").read_text()
    fid = page[page.index("Frechet"):]
    assert "| sirt |" in fid and "| tv |" in fid and "LPIPS alex" in page[:page.index("Frechet")]
    for row in read_csv(tmp_path / "out" / "fid.csv"):
        (line,) = (line for line in fid.splitlines() if line.startswith(f"| {row['method']} |"))
        assert all(f"{row[name]:.3f}" in line for name in NAMES) and row["cases"] == 2
        assert all(row[f"{of}slices_{plane}"] == 68 for of in ("", "truth_") for plane in PLANES)
        assert row["fid_backbone"] == "squeezenet" and row["fid_normalisation"] in page
    made = (tmp_path / "out" / "index.html").read_text()
    main(["page", str(tmp_path / "out")])
    assert "Frechet distance of slices" in made and (tmp_path / "out" / "index.html").read_text() == made
    next((tmp_path / "out" / "features").iterdir()).unlink()
    capsys.readouterr()
    main(args)
    assert "3 of 4 rows are there already" in capsys.readouterr().err
    assert (tmp_path / "out" / "tables.md").read_text()[page.index("Frechet"):] == fid


def test_a_row_whose_features_cannot_be_made_again_is_left_out_of_the_distances(tmp_path, untrained, monkeypatch):
    file, out = tmp_path / "spec.yaml", tmp_path / "out"
    file.write_text(yaml.safe_dump({
        "out": str(out), "phantoms": 2, "metrics": ["fid"], "fid": {"replicates": 0},
        "base": {"voxels": 34, "detector": 24, "views": 3, "method.iterations": 2}, "axes": {"method": ["sirt"]}}))
    args = ["ablate", "-c", str(file), "--device", "cpu"]
    main(args)
    rows = read_csv(out / "results.csv")
    (out / "features" / f"{rows[0]['key']}.safetensors").unlink()

    def give_up(*_):
        raise RuntimeError("no")

    monkeypatch.setattr(SIRT, "solve", give_up)
    main(args)
    assert read_csv(out / "results.csv") == rows and [row["cases"] for row in read_csv(out / "fid.csv")] == [1]


@pytest.mark.parametrize("given, sentence", [
    (["--metrics=[psnr]"], "metrics is a list of some of volume, lpips, fid"),
    (["--metrics=[fid]", "--fid.backbone=radimagenet"], "needs its weights: give fid.weights"),
    (["--metrics=[fid]", "--fid.backbone=vgg"], "fid.backbone is one of"),
    (["--fid.backbone=radimagenet"], "add fid to the metrics"),
    (["--fid.replicates=-1"], "fid.replicates"),
])
def test_what_cannot_be_measured_is_refused_before_any_work(tmp_path, capsys, given, sentence):
    assert sentence in refusal(capsys, main, phantoms(tmp_path, 1, *given))
    assert not (tmp_path / "sirt" / "phantom-1000000").exists()


@pytest.mark.parametrize("metric, of", [("fid", "the FID backbone squeezenet"), ("lpips", "LPIPS")])
def test_volumes_that_are_too_small_for_a_metric_are_refused_before_any_work(tmp_path, capsys, untrained, monkeypatch,
                                                                             metric, of):
    monkeypatch.setattr(SIRT, "reconstruct", None)
    said = refusal(capsys, main, phantoms(tmp_path, 1, "--model.grid=16", f"--metrics=[{metric}]"))
    assert f"16 x 16 x 16 voxels are too small for {of}" in said and f"leave {metric} out" in said
    assert not (tmp_path / "sirt" / "phantom-1000000").exists()
    Scoring(["fid"]).check(Grid.cube(backbones.LEAST_SIDE))
    Scoring(["lpips"]).check(Grid.cube(perceptual.LEAST_SIDE))
    Scoring(["fid"], FIDSettings(maisi_voxels=True)).check(Grid.cube(16))


@pytest.mark.parametrize("metric", ["fid", "lpips"])
def test_ablate_refuses_volumes_that_are_too_small_for_a_metric_before_any_work(tmp_path, capsys, untrained, metric):
    file, out = tmp_path / "spec.yaml", tmp_path / "out"
    file.write_text(yaml.safe_dump({"out": str(out), "phantoms": 1, "metrics": [metric], "base": {"voxels": 16},
                                    "axes": {"method": ["sirt"]}}))
    said = refusal(capsys, main, ["ablate", "-c", str(file), "--device", "cpu"])
    assert "16 x 16 x 16 voxels are too small" in said and f"leave {metric} out" in said
    assert not (out / "results.csv").exists()


def test_a_specification_with_unknown_metrics_is_refused(tmp_path, capsys):
    for content, sentence in (({"metrics": ["psnr"]}, "some of volume"), ({"fid": {"net": 1}}, "no setting 'net'"),
                              ({"metrics": 3}, "metrics takes")):
        file = tmp_path / "spec.yaml"
        file.write_text(yaml.safe_dump({"out": str(tmp_path / "out"), "phantoms": 1, "axes": {"method": ["sirt"]}}
                                       | content))
        assert sentence in refusal(capsys, main, ["ablate", "-c", str(file), "--device", "cpu"])


def test_lungs_that_are_segmented_beside_a_ct_are_those_of_the_truth(tmp_path):
    grid, ct = Grid.cube(24, 240.0), tmp_path / "anna.nii.gz"
    lung = np.zeros(grid.shape, np.float32)
    lung[4:20, 6:18, 5:15] = 1
    for name in ("anna", "anna_lungmask"):
        nibabel.save(nibabel.Nifti1Image(lung, grid.affine), tmp_path / f"{name}.nii.gz")
    found = organs_beside(ct, Grid.cube(48, 240.0))
    assert found.keys() == {"lung"}
    assert dice(found["lung"], lung.repeat(2, 0).repeat(2, 1).repeat(2, 2) > 0) > 0.999  # but for its corners
    assert organs_beside(tmp_path / "bert.nii.gz", grid) == {}


def test_masks_beside_a_ct_whose_header_is_not_trusted_lie_where_the_ct_does(tmp_path):
    hu = np.full((24, 24, 24), -1000, np.int16)
    hu[2:22, 3:21] = 0
    hu[6:18, 6:18, 5:15] = -850
    blank = np.eye(4)  # of 1 mm, whereas the voxels have 10
    stored = (hu + 500) // 2
    for name, voxels in (("valid_1_a_1", stored), ("valid_1_a_1_lungmask", (hu == -850).astype(np.int16))):
        nibabel.save(nibabel.Nifti1Image(voxels, blank), tmp_path / f"{name}.nii.gz")
    table = tmp_path / "metadata.csv"
    table.write_text("VolumeName,RescaleSlope,RescaleIntercept,XYSpacing,ZSpacing\n"
                     'valid_1_a_1.nii.gz,2,-500,"[10.0, 10.0]",10.0\n')
    source, grid = CTSource(metadata=str(table), fixed=False), Grid.cube(24, 240.0)
    (_, _, make), = ReconstructionData(cts=str(tmp_path), source=source).test_cases(grid, HUWindow())
    case = make()
    lung = case["masks"][0].numpy().repeat(4, 0).repeat(4, 1).repeat(4, 2) > 0.5
    assert dice(segmented(case, grid)["lung"], lung) > 0.9
    cut = nibabel.Nifti1Image((hu == -850)[6:].astype(np.int16), blank)
    nibabel.save(cut, tmp_path / "valid_1_a_1_lungmask.nii.gz")
    with pytest.raises(ValueError, match="valid_1_a_1_lungmask.nii.gz does not lie on its CT's voxels"):
        segmented(case, grid)  # placed by the CT's own first voxel, lungs would lie 60 mm beside


def test_masks_beside_a_ct_that_lie_elsewhere_are_refused_as_where_cts_are_prepared(tmp_path):
    grid, lung = Grid.cube(24, 240.0), np.ones((24, 24, 24), np.float32)
    nibabel.save(nibabel.Nifti1Image(lung, grid.affine), tmp_path / "anna.nii.gz")
    for other in (Grid.cube(24, 120.0), Grid.cube(12, 120.0)):
        nibabel.save(nibabel.Nifti1Image(lung[:other.shape[0]], other.affine), tmp_path / "anna_lungmask.nii.gz")
        with pytest.raises(ValueError, match="anna_lungmask.nii.gz does not lie on its CT's voxels"):
            organs_beside(tmp_path / "anna.nii.gz", grid)


def test_masks_beside_a_ct_that_lie_elsewhere_are_refused_before_it_is_reconstructed(tmp_path, monkeypatch, capsys):
    ct = write_ct(tmp_path / "cts" / "anna.nii.gz", 0)
    nibabel.save(nibabel.Nifti1Image(np.ones((12, 12, 12), np.uint8), np.eye(4)), ct.with_name("anna_lungmask.nii.gz"))
    monkeypatch.setattr(SIRT, "solve", lambda *_: pytest.fail("it is reconstructed"))
    said = refusal(capsys, main, sirt("test", tmp_path / "out", f"--data.cts={ct.parent}", *ORBIT, "--model.grid=16",
                                      "--metrics=[organs]"))
    assert "anna_lungmask.nii.gz does not lie on its CT's voxels" in said
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump({
        "cts": str(ct.parent), "metrics": ["organs"], "base": {"voxels": 16, "detector": 24, "views": 3},
        "axes": {"method": ["sirt"]}}))
    refusal(capsys, main, ["ablate", "-c", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "rows"),
                           "--device", "cpu"])
    [row] = read_csv(tmp_path / "rows" / "results.csv")
    assert "anna_lungmask.nii.gz does not lie on its CT's voxels" in row["error"]


def source_of(ct) -> str:
    (_, source, _), = ReconstructionData(cts=str(ct)).test_cases(Grid.cube(16), HUWindow())
    return source


def test_other_voxels_beside_the_same_header_are_other_data(tmp_path):
    (tmp_path / "anna.mhd").write_text("ElementDataFile = anna.raw\n")
    found = []
    for content in (b"one", b"other"):
        (tmp_path / "anna.raw").write_bytes(content)
        found.append(source_of(tmp_path / "anna.mhd"))
    assert found[0] != found[1]


def test_cases_of_other_masks_are_other_data_and_those_without_are_known_by_the_ct_alone(tmp_path):
    ct, mask = tmp_path / "anna.nii.gz", tmp_path / "anna_lungmask.nii.gz"
    ct.write_bytes(b"ct")
    alone = source_of(ct)
    assert alone == f"anna.nii.gz, crc32 {file_crc32(ct):08x}, None, report crc32 00000000"
    found = []
    for content in (b"one", b"other"):
        mask.write_bytes(content)
        found.append(source_of(ct))
    mask.unlink()
    assert len({alone, *found}) == 3 and source_of(ct) == alone


def test_the_prepared_lungs_are_those_of_the_truth_and_its_vessels_are_found_in_the_ct(tmp_path):
    grid = Grid.cube(24, 240.0)
    lung = np.zeros(grid.shape, np.float32)
    lung[4:20, 6:18, 5:15] = 1
    for space in ("patient", "medsyn"):
        folder = tmp_path / space / "anna"
        folder.mkdir(parents=True)
        record = {"id": "anna", "space": space, "extent": [240.0] * 3, "window": [-1000, 1000], "report": "", "row": {}}
        write_prepared(folder, grid, {"ct": 1000 * lung, "lung": lung, "vessel": lung}, record)
        found = organs_beside(folder / "ct.nii.gz", grid)
        assert found.keys() == {"lung"} and np.array_equal(found["lung"], lung > 0)
        (folder / "lung.nii.gz").unlink()
        assert organs_beside(folder / "ct.nii.gz", grid) == {}


def test_the_distance_of_a_region_is_that_of_its_own_slices(tmp_path, untrained):
    """Also after that of the whole of the same case."""
    def distances(name: str, products: list) -> dict:
        file = tmp_path / f"{name}.yaml"
        file.write_text(yaml.safe_dump({
            "out": str(tmp_path / name), "phantoms": 2, "metrics": ["fid"], "fid": {"replicates": 0},
            "base": {"detector": 24, "views": 3, "method.iterations": 2}, "products": products}))
        main(["ablate", "-c", str(file), "--device", "cpu"])
        return {row["method"]: row["fid"] for row in read_csv(tmp_path / name / "fid.csv")}

    whole = {"base": {"voxels": 48}, "axes": {"method": ["tv"]}}
    region = {"base": {"voxels": 34, "side": 272.0}, "axes": {"method": ["sirt"]}}
    assert distances("both", [whole, region])["sirt"] == distances("alone", [region])["sirt"]


def test_fid_on_maisis_voxels_has_their_slices_says_so_and_its_page_is_made_anew(tmp_path, untrained, monkeypatch):
    monkeypatch.setattr(backbones, "MAISI_SIDE", 40)
    main(phantoms(tmp_path, 1, "--model.grid=34", "--metrics=[fid]", "--fid.maisi_voxels=true"))
    table, page = (tmp_path / "sirt" / "results.md").read_text(), tmp_path / "index.html"
    made = page.read_text()
    assert all(text in told for told in (table, made)
               for text in ("512^3 voxels of 1 mm", "XY 40, YZ 40, ZX 40 slices"))
    main(["page", str(tmp_path)])
    assert page.read_text() == made


def test_other_weights_of_a_network_are_another_score(tmp_path, monkeypatch):
    monkeypatch.setattr(scoring, "SliceFeatures", lambda *_: object())
    file, found = tmp_path / "inception.pth", []
    for content in (b"one", b"two"):
        file.write_bytes(content)
        found.append(Scoring(["fid"], FIDSettings("inception", str(file))).settings())
    assert found[0] != found[1]


@pytest.mark.parametrize("metric", ["fid", "lpips"])
def test_other_weights_that_torch_hub_finds_are_another_score(metric, untrained):
    networks = [load_lpips(backbone, True) for backbone in perceptual.BACKBONES]
    before = Scoring([metric]).settings()
    weight = next(networks[-1].net.parameters())  # SqueezeNet's, which both metrics take
    with torch.no_grad():
        weight += 1
        other = Scoring([metric]).settings()
        weight -= 1
    assert before != other and before | {f"{metric}_weights_crc32": 0} == other | {f"{metric}_weights_crc32": 0}


def test_settings_name_what_decides_the_scores_and_nothing_by_default(untrained):
    assert Scoring().settings() == {} == Scoring(["volume"]).settings()
    one, again = (Scoring(["fid", "volume"], FIDSettings(replicates=n)).settings() for n in (5, 6))
    assert one == again and one.keys() == {"metrics", "fid_backbone", "fid_weights_crc32"}
    resampled = Scoring(["fid"], FIDSettings(maisi_voxels=True))
    assert resampled.settings() == Scoring(["fid"]).settings() | {"fid_maisi_voxels": True}
    assert Scoring(["organs"]).settings() == {"metrics": ["organs"], "organs_version": 3}


@pytest.mark.parametrize("order", [[[0, 1], [1, 1], [2, -1]], [[2, 1], [1, 1], [0, 1]], [[1, -1], [2, 1], [0, -1]]],
                         ids=["upside down", "slices first", "cyclic"])
def test_scores_do_not_depend_on_the_order_of_a_priors_axes(order):
    window, grid = HUWindow(), Grid.box((32, 30, 34), (384.0, 360.0, 408.0))
    case = phantom_case(3, grid, window)
    case["volume"][:, :, :6] = 0.04  # a couch along the back
    truth = window.to_hu(case["volume"])[0]
    blurred = torch.from_numpy(gaussian_filter(truth.numpy(), (0.5, 0.5, 1.5)))
    turn, turned = np.array(order), dict(case)
    there = Grid([grid.shape[axis] for axis in turn[:, 0].argsort()],
                 affine=grid.affine @ inv_ornt_aff(turn, grid.shape))

    def of(volume: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(apply_orientation(volume.numpy(), turn).copy())

    turned |= {"volume": of(case["volume"][0])[None], "masks": torch.stack([*map(of, case["masks"])])}
    found, nothing = [], torch.zeros(1, 1, 1)
    for made, own, volume in ((case, grid, blurred), (turned, there, of(blurred))):
        voxels, result = Voxels(own), Reconstruction(volume, own, "mine", 0, 0.0, [0.0], {}, nothing, nothing)
        scored = voxels.as_scored(made, window)
        scores, _ = Scoring(["sharpness"]).measured(result, scored, voxels.scored, window, torch.device("cpu"), None)
        found.append(scores)
        shown = in_its_ct(result, scored, voxels.scored, window)[1]
        torch.testing.assert_close(shown, window.to_hu(made["volume"])[0], rtol=0, atol=1e-3)
    assert {"psnr_body", "ssim_lung", "edge_diaphragm", "edge_chest_wall", "vessels"} <= found[0].keys()
    assert found[1] == pytest.approx(found[0], rel=1e-4)
