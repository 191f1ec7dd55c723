"""The page of results in a real browser, from disk; skipped where no Chromium or no playwright is found."""

import base64
import json
import re
import shutil
from itertools import product
from urllib.parse import quote

import nibabel
import numpy as np
import pytest
import torch
import yaml
from scenes import voxel_centres

from page.made import TURNED, finish
from phydict.cli.infer import main
from phydict.evaluation import read_csv, write_csv
from phydict.grid import Grid
from phydict.inference.page import results_page
from phydict.page import Contents, write_case_files, write_page

BROWSER = next(filter(None, map(shutil.which, (
    "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"))), None)
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")

TURNING = "canvas[aria-label^='Projection']"
HOSTILE = "<script>alert('1')<∕script>\"é😀 #?%41&amp;"


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"], timeout=300_000)
        yield made
        made.close()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder of two methods' results on two cases, one of a hostile name."""
    out = tmp_path_factory.mktemp("out")
    of = [("anna", "sirt", 9.0), ("anna", "tv", 21.0), (HOSTILE, "sirt", 100.0)]
    for seed, (case, method, psnr) in enumerate(of):
        finish(out, case, method, seed=seed, report=HOSTILE, warnings=[HOSTILE], scores={"psnr": psnr})
    fine = Grid((12, 18, 14), affine=[[-2, 0, 0, 12], [0, 1.5, 0, -8], [0, 0, 2.5, -21], [0, 0, 0, 1]])
    finish(out, "anna", "fine", grid=fine, seed=7, scores=None)
    results_page(out)
    return out


@pytest.fixture
def shown(browser, results):
    """Opens the page, of a case where a hash names it; at the end nothing was said on its console."""
    said, pages = [], []

    def show(place: str = "", folder=results, **context):
        page = browser.new_page(**context)
        pages.append(page)
        page.set_default_timeout(60_000)
        page.on("console", lambda message: message.type == "error" and said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("dialog", lambda dialog: said.append(dialog.message) or dialog.dismiss())
        page.on("request", lambda request: request.url.startswith("file:") or said.append(request.url))
        page.goto((folder / "index.html").as_uri() + place)
        if place:
            page.wait_for_selector("#viewer:not([hidden])")
            page.wait_for_function("document.getElementById('state').textContent === ''")
        return page

    yield show
    for page in pages:
        page.close()
    assert said == []


def readout(page) -> tuple[np.ndarray, dict[str, int]]:
    """The crosshair's place in mm and the HU there of each volume."""
    place, values = page.inner_text("#readout").split(" mm RAS+: ")
    return np.array(eval(place)), {name: int(hu) for name, hu in re.findall(r"([a-z][a-z ]*?) (-?\d+) HU", values)}


def pixels(page, selector: str) -> np.ndarray:
    """A canvas's picture (height, width, RGBA)."""
    width, values = page.eval_on_selector(selector, """canvas => {
        const values = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
        return [canvas.width, btoa(values.reduce((text, value) => text + String.fromCharCode(value), ""))];}""")
    return np.frombuffer(base64.b64decode(values), np.uint8).reshape(-1, width, 4).astype(int)


def look(page, selector: str) -> str:
    """A canvas's picture, as text."""
    return page.eval_on_selector(selector, "canvas => canvas.toDataURL()")


def test_the_hu_under_the_crosshair_is_the_files_wherever_it_is_moved(shown, results):
    page = shown("#sirt%2Fanna")
    image = nibabel.load(results / "sirt" / "anna" / "volume.nii.gz")
    seen = set()
    for act in (lambda: None, lambda: page.click("[data-plane=axial][data-row='0']", position={"x": 20, "y": 30}),
                lambda: page.keyboard.press("ArrowRight"), lambda: page.keyboard.press("PageUp"),
                lambda: page.click("[data-plane=sagittal][data-row='0']", position={"x": 60, "y": 10})):
        act()
        mm, hu = readout(page)
        index = np.rint(np.linalg.inv(image.affine) @ [*mm, 1]).astype(int)[:3]
        assert hu["reconstruction"] == round(float(image.dataobj[tuple(index)]))
        seen.add(tuple(mm))
    assert len(seen) == 5


def test_kept_volumes_of_a_comparison_are_seen_beside_those_of_other_settings(shown, tmp_path):
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump({
        "phantoms": 1, "base": {"voxels": 16, "detector": 24, "views": 3}, "axes": {
            "method": ["sirt"], "method.iterations": [2, 5]}}))
    main(["ablate", "-c", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "out"), "--keep_volumes"])
    names = [f"sirt, iterations {n}, seed 0" for n in (2, 5)]
    [case] = {row["case"] for row in read_csv(tmp_path / "out" / "results.csv")}
    page = shown("#" + quote(f"{names[0]}/{case}", safe=""), folder=tmp_path / "out")
    assert page.locator("#other option").all_inner_texts() == ["nothing", "truth", names[1]]
    page.select_option("#other", label=names[1])
    page.wait_for_function(f"document.getElementById('readout').textContent.includes('{names[1]}')")
    assert page.locator("[data-plane=axial][data-row='1']").is_visible()
    shutil.rmtree(next(path for path in (tmp_path / "out" / "volumes").iterdir()
                       if json.loads((path / "details.json").read_text())["settings"]["method"]["iterations"] == 5))
    main(["page", str(tmp_path / "out")])
    page = shown("#" + quote(f"{names[0]}/{case}", safe=""), folder=tmp_path / "out")
    assert page.locator("#other option").all_inner_texts() == ["nothing", "truth"]


def test_of_a_case_without_a_volume_what_is_known_is_shown_and_how_volumes_are_kept(shown, tmp_path):
    write_csv(tmp_path / "results.csv", [{
        "case": "anna", "method": "sirt", "views": 2, "seed": 0, "simulator": "ideal", "status": "ok", "psnr": 20.0,
        "mae_hu": 50.0, "misfit": 0.1, "seconds": 1.23456, "network_calls": 0, "key": "k"}])
    main(["page", str(tmp_path)])
    page = shown(folder=tmp_path)
    page.wait_for_function("document.getElementById('state').textContent.includes('ablate --keep_volumes keeps them')")
    page.click("summary")
    said = page.inner_text("body")
    assert not re.search("undefined|null|None|Files|Report|picture", said) and "1.235 s" in said
    assert [page.is_visible(name) for name in ("#viewer", "#settings", "td img")] == [False] * 3


def test_a_click_points_to_what_the_radiological_display_shows_there(shown):
    page = shown("#sirt%2Fanna")
    box = page.locator("[data-plane=axial][data-row='0']").bounding_box()
    page.click("[data-plane=axial][data-row='0']", position={"x": 2, "y": 2})
    (right, front, _), _ = readout(page)
    page.click("[data-plane=axial][data-row='0']", position={"x": box["width"] - 2, "y": box["height"] - 2})
    (left, back, _), _ = readout(page)
    assert right == left + 4 * 8 and front == back + 3 * 5  # RAS+: x grows to the right, y to the front


def test_wheel_and_keys_change_the_slice_that_a_screen_reader_is_told(shown):
    page = shown("#sirt%2Fanna")
    canvas = page.locator("[data-plane=coronal][data-row='0']")
    before = look(page, "[data-plane=coronal][data-row='0']"), int(canvas.get_attribute("aria-valuenow"))
    canvas.hover()
    page.mouse.wheel(0, -100)
    page.wait_for_function("n => document.querySelector('[data-plane=coronal]').ariaValueNow == n + 1", arg=before[1])
    assert look(page, "[data-plane=coronal][data-row='0']") != before[0]
    canvas.focus()
    page.keyboard.press("PageDown")
    assert int(canvas.get_attribute("aria-valuenow")) == before[1]
    assert look(page, "[data-plane=coronal][data-row='0']") == before[0]
    assert re.fullmatch(r"slice \d of 6, -?\d+\.\d mm", canvas.get_attribute("aria-valuetext"))
    for key, end in (("End", "6"), ("Home", "1"), ("ArrowUp", "2"), ("ArrowRight", "3"), ("ArrowLeft", "2"),
                     ("ArrowDown", "1")):
        page.keyboard.press(key)
        assert canvas.get_attribute("aria-valuenow") == end


def test_keys_of_the_browser_change_no_slice(shown):
    page = shown("#sirt%2Fanna")
    canvas = page.locator("[data-plane=coronal][data-row='0']")
    before = canvas.get_attribute("aria-valuenow")
    for held in ("altKey", "ctrlKey", "metaKey"):
        assert canvas.evaluate("(canvas, held) => canvas.dispatchEvent(new KeyboardEvent('keydown', "
                               "{key: 'ArrowUp', cancelable: true, [held]: true}))", held)
        assert canvas.get_attribute("aria-valuenow") == before


def test_the_small_steps_of_a_trackpad_add_up_to_slices(shown):
    page = shown("#sirt%2Fanna")
    canvas = page.locator("[data-plane=coronal][data-row='0']")
    slices = []
    for delta in [10] * 8 + [-10] * 4:
        canvas.dispatch_event("wheel", {"deltaY": delta})
        slices.append(int(canvas.get_attribute("aria-valuenow")))
    assert slices == [4, 4, 4, 3, 3, 3, 3, 2, 2, 2, 2, 3]


def test_a_finger_scrolls_over_pictures_upwards_and_its_tap_or_drag_across_sets_the_crosshair(shown):
    page = shown("#sirt%2Fanna", viewport={"width": 400, "height": 600}, has_touch=True, is_mobile=True)
    touch, before = page.context.new_cdp_session(page), readout(page)[0]

    def swipe(x: float, y: float, across: int, up: int):
        for n, kind in enumerate(["Start", *["Move"] * 10]):
            touch.send("Input.dispatchTouchEvent", {
                "type": f"touch{kind}", "touchPoints": [{"x": x + n * across, "y": y - n * up}]})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    for name in ("[data-plane=axial][data-row='0']", TURNING, "#xray", "#residual"):
        page.eval_on_selector(name, "canvas => canvas.scrollIntoView({block: 'center'})")
        box, top = page.locator(name).first.bounding_box(), page.evaluate("scrollY")
        swipe(box["x"] + 20, box["y"] + 20, 0, 15)
        page.wait_for_function("top => scrollY > top + 50", arg=top)
        assert (readout(page)[0] == before).all()
    plane = page.locator("[data-plane=axial][data-row='0']")
    plane.tap(position={"x": 5, "y": 5})
    assert (tapped := readout(page)[0])[0] > before[0]
    box = plane.bounding_box()
    swipe(box["x"] + 20, box["y"] + 20, 12, 0)
    assert readout(page)[0][0] < tapped[0]  # dragged to the patient's left


def test_another_method_of_the_same_case_opens_at_the_same_place(shown):
    page = shown("#sirt%2Fanna")
    page.click("[data-plane=axial][data-row='0']", position={"x": 20, "y": 30})
    page.keyboard.press("PageUp")
    before = readout(page)[0]
    for method, wrong in (("tv", 0), ("fine", 1.3), ("sirt", 2.5)):  # half a voxel of each, and of the one before
        page.click(f"[data-key='{method}/anna'] button.name")
        page.wait_for_function("name => document.getElementById('case-name').textContent.endsWith(name) && "
                               "document.getElementById('state').textContent === ''", arg=method)
        assert np.abs(readout(page)[0] - before).max() <= wrong


def test_from_an_open_case_links_lead_to_its_neighbours_and_to_all_cases(shown):
    page = shown("#sirt%2Fanna")
    names = [row.get_attribute("data-key") for row in page.locator("tr[data-key]").all()]
    at = names.index("sirt/anna")
    for name, place in (("next", at + 1), ("previous", at)):
        page.focus(f"#{name}")
        page.keyboard.press("Enter")
        page.wait_for_selector(f"tr[data-key={json.dumps(names[place])}][aria-current=true]")
    page.fill("[type=search]", "sirt/anna")
    page.click("[data-key='sirt/anna'] button.name")
    page.wait_for_selector("#next", state="hidden")
    page.click("text=all cases")
    page.wait_for_selector("#case", state="hidden")
    assert page.locator("#cases caption").is_visible()


def test_links_to_neighbours_follow_the_table_as_it_is_sorted_and_searched_by_words_in_any_order(shown):
    page = shown("#sirt%2Fanna")

    def neighbours() -> list[str | None]:
        return [page.locator(f"#{name}").get_attribute("title") or None for name in ("previous", "next")]

    page.locator("#cases th", has_text="PSNR").locator("button").click()
    assert neighbours() == [None, "tv/anna"]
    page.locator("#cases th", has_text="PSNR").locator("button").click()
    assert neighbours() == ["tv/anna", "fine/anna"]
    page.fill("[type=search]", " ANNA  sirt ")
    assert page.locator("tr[data-key]:visible").count() == 1 and neighbours() == [None, None]


def test_an_address_that_is_none_opens_no_case(shown):
    page = shown()
    page.goto(page.url + "#%E0%A4%A")
    assert page.locator("tr[data-key]").count() == 4 and not page.is_visible("#case")


def test_the_open_case_can_be_gone_back_to(shown):
    page = shown("#sirt%2Fanna")
    page.locator("[data-key='sirt/anna'] button.name").click()
    page.wait_for_function("document.activeElement.id === 'case-name'")


def test_a_case_that_has_loaded_leaves_the_focus_where_the_reader_went_meanwhile(shown):
    page = shown("#sirt%2Fanna")
    page.evaluate("""() => {
        const at_once = load;
        load = case_ => new Promise(go => { window.go = go; }).then(() => at_once(case_));
    }""")
    page.focus("#next")
    page.keyboard.press("Enter")
    page.wait_for_function("'go' in window")
    page.focus("#previous")
    page.evaluate("go()")
    page.wait_for_function("document.getElementById('state').textContent === ''")
    assert page.evaluate("document.activeElement.id") == "previous"


def test_windows_overlay_and_difference_change_what_is_shown(shown):
    page, plane = shown("#sirt%2Fanna"), "[data-plane=axial][data-row='0']"
    looks = []
    for name in ("lung", "soft tissue", "bone"):
        page.click(f"button:text-is('{name}')")
        assert page.get_attribute(f"button:text-is('{name}')", "aria-pressed") == "true"
        looks.append(look(page, plane))
    page.fill("#level", "-100")
    looks.append(look(page, plane))
    page.check("#overlay")
    looks.append(look(page, plane))
    assert len(set(looks)) == len(looks)
    beside = look(page, "[data-plane=axial][data-row='1']")
    page.select_option("#way", "difference")
    assert look(page, "[data-plane=axial][data-row='1']") != beside


def test_the_difference_is_read_out_and_none_is_offered_beside_nothing(shown):
    page = shown("#sirt%2Fanna")
    scales = ["#difference-scale", "#overlay-scale"]
    assert [page.is_visible(scale) for scale in scales] == [False, False]
    page.select_option("#way", "difference")
    page.check("#overlay")
    assert [page.is_visible(scale) for scale in scales] == [True, True]
    hu = readout(page)[1]
    assert hu["difference from truth"] == hu["reconstruction"] - hu["truth"]
    caption = page.locator("figure:has([data-plane=axial][data-row='1']) figcaption").inner_text()
    assert caption == "axial, difference from truth, slice 4 of 7"
    page.select_option("#other", label="nothing")
    page.wait_for_selector("#way[disabled]")
    assert "difference from truth" not in readout(page)[1] and not page.is_visible("#difference-scale")


def test_letters_and_crosshair_have_a_dark_rim_on_white(shown, tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    same = np.zeros(TURNED.shape)
    write_case_files(folder, TURNED, {"reconstruction": same, "truth": same})
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    page.select_option("#way", "difference")
    shades = pixels(page, "[data-plane=axial][data-row='1']")
    middle = len(shades) // 2
    for part in (shades[:20, 170:190], shades[-20:, 170:190], *np.split(shades[middle - 10:middle + 10], [20, 340], 1)):
        assert part.max() == 255 and part[..., :3].max(-1).min() < 140


def test_projections_side_by_side_share_one_window(shown, tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    same = np.full(TURNED.shape, 100.0)
    brighter = same.copy()
    brighter[3, 4, 3] = 3000
    write_case_files(folder, TURNED, {"reconstruction": same, "truth": brighter})
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    for kind in ("maximum", "mean"):
        page.fill("[aria-label='Angle of the projection']", "30")
        one, other = (pixels(page, f":nth-match({TURNING}, {n})")[..., 0] for n in (1, 2))
        assert (one == other).mean() > 0.9 and other.max() == 255 > one.max() > 0
        assert page.locator(f"figure:has({TURNING}) figcaption").all_inner_texts() == [
            f"{name}, {kind} along rays, 30°" for name in ("reconstruction", "truth")]
        page.click("button:text-is('mean')")


def test_a_projection_skips_no_slice_and_has_the_volume_s_extent(shown):
    page = shown()
    for shape, spacing in (((150, 150, 9), (1, 1, 5)), ((40, 45, 140), (5, 5, 0.5))):
        for axis, mean in product(range(3), (False, True)):
            seen = page.evaluate("""([shape, spacing, axis, mean]) => {
                const rows = at => [0, 1, 2].map(a => [...[0, 1, 2].map(b => a === b ? at(spacing[a]) : 0), 0]);
                const strides = [1, shape[0], shape[0] * shape[1]];
                return [4, 5].map(slice => {
                  const data = Int16Array.from({length: shape[0] * shape[1] * shape[2]}, (_, n) =>
                    Math.floor(n / strides[axis]) % shape[axis] === slice ? 1000 : -1024);
                  const volume = new Volume("", data, {shape, affine: rows(s => s), inverse: rows(s => 1 / s)});
                  const {values, ratio} = volume.projection(0, mean);
                  return [values.reduce((a, b) => Math.max(a, b)), ratio];
                });}""", [shape, spacing, axis, mean])
            assert all(most == 1000 if not mean else most > -1024 for most, _ in seen)
            wide = np.hypot(*np.multiply(shape, spacing)[:2])
            assert np.allclose([ratio for _, ratio in seen], shape[2] * spacing[2] / wide, rtol=0.03)


def test_projections_of_volumes_on_other_voxels_show_what_is_in_the_same_place(shown, tmp_path):
    grids = {"whole": Grid.cube(32), "region": Grid.box(48, 150.0, (30, 0, 20))}
    for method, grid in grids.items():
        ball = np.where(((voxel_centres(grid) - [40, 0, 30]) ** 2).sum(-1) < 30**2, 500.0, -1000.0)
        write_case_files(finish(tmp_path, "anna", method, grid=grid), grid, {"reconstruction": ball})
    results_page(tmp_path)
    page = shown("#whole%2Fanna", folder=tmp_path)
    page.select_option("#other", label="region")
    page.wait_for_selector(f":nth-match({TURNING}, 2)")
    one, other = (pixels(page, f":nth-match({TURNING}, {n})")[..., 0] > 100 for n in (1, 2))
    assert one.shape == other.shape and (one & other).sum() > 0.8 * (one | other).sum() > 0


def test_a_window_can_be_typed_anew(shown):
    page = shown("#sirt%2Fanna")
    page.click("#width")
    page.keyboard.press("Control+a")
    page.keyboard.press("Delete")
    page.keyboard.type("1500")
    assert page.input_value("#width") == "1500"


def test_voxels_without_a_value_stay_marked_beneath_the_overlay(shown, tmp_path):
    hu = np.zeros(TURNED.shape)
    hu[3, 4, 3] = np.nan
    write_case_files(finish(tmp_path, "anna", "sirt"), TURNED, {
        "reconstruction": hu, "standard deviation": np.full(TURNED.shape, 100.0)})
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    counts = []
    for act in (page.uncheck, page.check):
        act("#overlay")
        counts.append((pixels(page, "[data-plane=axial][data-row='0']")[..., :3] == [255, 0, 255]).all(-1).sum())
    assert counts[0] == counts[1] > 100


def test_no_list_is_filled_for_each_pixel(shown):
    page = shown("#sirt%2Fanna")
    assert page.evaluate("""() => {
        const fill = Array.prototype.fill;
        let count = 0;
        Array.prototype.fill = function (...given) { count++; return fill.apply(this, given); };
        viewer.draw();
        xrayViewer.draw();
        Array.prototype.fill = fill;
        return count;}""") == 0


@pytest.mark.parametrize("shape, pixel, ratio", [((8, 10), 2.0, 1.6), ((1, 600), 1.0, 1 / 15), ((600, 1), 1.0, 4.0)])
def test_xrays_have_the_detectors_aspect_and_those_of_a_line_are_seen(shown, tmp_path, shape, pixel, ratio):
    y = torch.rand(3, *shape)
    write_case_files(finish(tmp_path, "anna", "sirt"), TURNED, {"reconstruction": np.zeros(TURNED.shape)}, y, y + 1,
                     pixel=pixel)
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    for name in ("#xray", "#residual"):
        assert pixels(page, name).shape[:2] == (round(360 * ratio), 360)


def test_xrays_of_older_files_have_square_pixels(shown, tmp_path):
    file = finish(tmp_path, "anna", "sirt") / "view.js"
    file.write_text(file.read_text().replace('"pixel": 1.0, ', ""))
    results_page(tmp_path)
    assert pixels(shown("#sirt%2Fanna", folder=tmp_path), "#xray").shape[:2] == (288, 360)


def test_a_browser_that_lacks_what_is_needed_is_named_as_the_reason_and_no_file_is(shown, results):
    page = shown()
    page.evaluate("() => { delete window.DecompressionStream; location.hash = 'sirt%2Fanna'; }")
    page.wait_for_function("document.getElementById('state').textContent.startsWith('The volume is not shown')")
    assert page.inner_text("#state") == ("The volume is not shown: this browser cannot show it, since it does not know "
                                         "DecompressionStream.")
    page = shown()
    page.evaluate("() => { delete window.OffscreenCanvas; location.hash = 'sirt%2Fanna'; }")
    page.wait_for_function("document.getElementById('state').textContent.includes('this browser cannot show it')")
    assert "Delete" not in page.inner_text("#state")


def test_without_xrays_the_misfit_of_each_view_is_shown_alone(shown, tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    (folder / "view.js").unlink()
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    assert [page.is_visible(name) for name in ("#xray", "#residual", "#bars")] == [False, False, True]
    page.locator("#bars button").nth(1).click()
    assert page.inner_text("#view-name") == "view 1 (of 0 to 2), misfit 0.200"


def test_another_methods_missing_volume_is_said_in_a_sentence(shown, tmp_path):
    finish(tmp_path, "anna", "sirt"), finish(tmp_path, "anna", "tv")
    results_page(tmp_path)
    (tmp_path / "tv" / "anna" / "view.js").write_text("phydictView(null);")
    page = shown("#sirt%2Fanna", folder=tmp_path)
    page.select_option("#other", label="tv")
    page.wait_for_function("document.getElementById('state').textContent.includes('The volume of tv is not shown')")


def test_truth_and_other_methods_stand_beside_a_volume_at_the_same_place(shown, results):
    page = shown("#sirt%2Fanna")
    assert set(readout(page)[1]) == {"reconstruction", "truth", "standard deviation"}
    for method in ("tv", "fine"):  # the second on other voxels
        page.select_option("#other", label=method)
        page.wait_for_function("name => document.getElementById('readout').textContent.includes(name)", arg=method)
        mm, hu = readout(page)
        image = nibabel.load(results / method / "anna" / "volume.nii.gz")
        index = np.linalg.inv(image.affine) @ [*mm, 1]
        nearest = [np.floor(index[:3] + 0.5 + nudge).astype(int) for nudge in product((-1e-6, 1e-6), repeat=3)]
        assert hu[method] in [round(float(image.dataobj[tuple(at)])) for at in nearest]


def test_xrays_follow_the_bars_and_the_slider(shown):
    page = shown("#sirt%2Fanna")
    assert [bar.get_attribute("aria-label") for bar in page.locator("#bars button").all()] == [
        "view 0: misfit 0.100", "view 1: misfit 0.200", "view 2: misfit 0.0500"]
    first = look(page, "#xray")
    page.locator("#bars button").nth(1).click()
    assert page.inner_text("#view-name") == "view 1 (of 0 to 2), misfit 0.200" and look(page, "#xray") != first
    second = look(page, "#xray")
    page.fill("#wipe", "100")
    assert look(page, "#xray") != second
    ends = [page.eval_on_selector("#residual", "(c, x) => [...c.getContext('2d').getImageData(x, 9, 1, 1).data]", x)
            for x in (0, 359)]
    assert ends == [[0, 0, 255, 255], [255, 0, 0, 255]]  # from -1 to 1 across


def test_the_label_at_each_side_of_the_edge_says_what_is_shown_there(shown):
    page = shown("#sirt%2Fanna")
    measured = np.random.default_rng(0).uniform(0, 5, (3, 8, 10))  # as `finish` makes them
    rendered = measured + np.linspace(-1, 1, 10)
    low, high = min(measured.min(), rendered.min()), max(measured.max(), rendered.max())
    shades = pixels(page, "#xray")[18::36, 18::36, 0]
    sides = dict(zip(page.inner_text("label:has(#wipe)").split(), (np.s_[:, :5], np.s_[:, 5:])))
    for name, values in (("measured", measured[0]), ("re-projected", rendered[0])):
        wanted = 255 * (values - low) / (high - low)
        assert np.abs(shades[sides[name]] - wanted[sides[name]]).max() < 1
    assert (pixels(page, "#xray")[:, 180, :3] == [90, 200, 255]).all()


def test_views_whose_misfit_was_not_kept_can_be_chosen(shown, tmp_path):
    finish(tmp_path, "anna", "sirt", misfit_per_view=[])
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    first = look(page, "#xray")
    page.click("#bars button:text-is('2')")
    assert look(page, "#xray") != first and page.inner_text("#view-name") == "view 2 (of 0 to 2)"


def test_a_click_on_a_column_sorts_by_number_and_puts_what_is_missing_last(shown):
    page = shown()

    def column() -> list[str]:
        return page.eval_on_selector_all("tr[data-key]", "rows => rows.map(row => row.cells[4].textContent)")

    head = page.locator("table:has(tr[data-key]) th", has_text="PSNR")
    wanted = ["9.00", "21.00", "100.00"]
    for direction, values in (("ascending", wanted), ("descending", wanted[::-1])):
        head.locator("button").click()
        assert column() == [*values, "–"] and head.get_attribute("aria-sort") == direction


def test_a_hostile_name_is_text_and_its_case_opens(shown):
    page = shown()
    page.click(f"button.name >> text={HOSTILE}")
    page.wait_for_selector("#viewer:not([hidden])")
    assert page.inner_text("#case-name") == f"{HOSTILE}: sirt"
    assert page.inner_text("#report") == HOSTILE == page.inner_text("#warnings li")
    assert page.locator("script").count() == 2  # the data and the page's own
    sources = page.eval_on_selector_all("#files a", "links => links.map(link => link.href)")
    assert len([name for name in sources if name.endswith("volume.nii.gz")]) == 1


def test_a_missing_volume_is_said_in_a_sentence(shown, tmp_path):
    folder = finish(tmp_path, "anna", "sirt")
    results_page(tmp_path)
    (folder / "view.js").write_text("phydictView(null);")
    page = shown(folder=tmp_path)  # its only case opens by itself
    page.wait_for_function("document.getElementById('state').textContent.includes('cannot be used, since it is dama')")


def test_a_projection_from_behind_is_the_mirrored_one_from_the_front_and_those_between_are_others(shown):
    page = shown("#sirt%2Fanna")

    def at(angle: int) -> np.ndarray:
        page.fill("[aria-label='Angle of the projection']", str(angle))
        return pixels(page, TURNING)[..., 0]

    for pressed in ("false", "true"):
        front, side, back = at(0), at(90), at(180)
        assert front.std() > 10 and np.abs(front - back[:, ::-1]).mean() < 2 < 10 < np.abs(front - side).mean()
        assert page.get_attribute("button:text-is('mean')", "aria-pressed") == pressed
        page.click("button:text-is('mean')")


def test_light_and_dark_follow_the_system(shown):
    backs = [shown(color_scheme=scheme).eval_on_selector("body", "body => getComputedStyle(body).backgroundColor")
             for scheme in ("light", "dark")]
    assert backs == ["rgb(255, 255, 255)", "rgb(20, 23, 27)"]


def test_two_hundred_cases_are_one_small_page_that_opens_within_three_seconds(shown, tmp_path):
    folder = finish(tmp_path, "0", "sirt")
    for case in range(1, 200):
        shutil.copytree(folder, tmp_path / "sirt" / str(case))
        made = (folder / "reconstruction.json").read_text().replace('"case": "0"', f'"case": "{case}"')
        (tmp_path / "sirt" / str(case) / "reconstruction.json").write_text(made)
    assert results_page(tmp_path).stat().st_size < 6e6
    page = shown(folder=tmp_path)
    browser = page.context.new_cdp_session(page)
    browser.send("Performance.enable", {"timeDomain": "threadTicks"})  # so that what else runs here does not count
    page.reload()
    assert page.locator("tr[data-key]").count() == 200
    seconds = {part["name"]: part["value"] for part in browser.send("Performance.getMetrics")["metrics"]}
    assert 0 < seconds["TaskDuration"] < 3
    page.fill("[type=search]", "/17")
    assert page.locator("tr[data-key]:visible").count() == 11  # 17 and 170 to 179
    page.fill("[type=search]", "nobody")
    assert page.locator("tr[data-key]:visible").count() == 0 and page.is_visible("text=none found")


def test_tables_are_told_to_a_screen_reader_and_scroll_with_their_names_in_sight(shown, tmp_path):
    finish(tmp_path, "phantom-1000000", "sirt", scores={"psnr": 20.0, "ssim_lung": 0.5})
    finish(tmp_path, "phantom-1000000", "tv", scores={"psnr": 21.0, "ssim_lung": 0.5})
    results_page(tmp_path)
    page = shown(folder=tmp_path, viewport={"width": 400, "height": 800})
    assert page.get_by_role("rowheader").all_inner_texts() == ["sirt", "tv", *["phantom-1000000"] * 2]
    assert page.locator("#cases thead th").all_inner_texts() == [
        "case", "picture", "method", "views", "PSNR (dB)\xa0↑", "misfit\xa0↓", "time (s)", "warnings",
        "SSIM lung\xa0↑"]
    table, name = page.get_by_role("region", name="Cases").last, page.locator("#cases tbody th").first
    table.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('#cases .scroll').scrollLeft > 0")
    assert name.bounding_box()["x"] == table.bounding_box()["x"] and name.bounding_box()["height"] < 60


def test_the_plot_names_its_dots_and_axes_and_no_number_twice(shown, tmp_path):
    points = [{"name": f"case {n}", "series": f"method {n}", "seconds": 14.0, "error": 180.0} for n in range(20)]
    write_page(tmp_path, Contents("many", points=points))
    page = shown(folder=tmp_path)
    texts = page.locator("svg text").all_text_contents()
    assert [text for text in texts if "method" not in text] == [
        "MAE (HU)", "seconds, logarithmic", "14", "180", "and 3 more"]
    assert page.get_by_role("img", name="case 7: 14 s, 180").count() == 1


def test_on_a_phone_the_plot_s_letters_are_as_large_as_elsewhere_and_it_scrolls(shown, tmp_path):
    write_page(tmp_path, Contents("two", points=[
        {"name": name, "series": name, "seconds": seconds, "error": 100.0 / seconds}
        for name, seconds in (("tv", 10.0), ("sirt", 20.0))]))
    pages = [shown(folder=tmp_path, viewport={"width": width, "height": 800}) for width in (1200, 400)]
    wide, narrow = (page.locator("svg text").first.bounding_box() for page in pages)
    assert narrow["height"] == wide["height"]
    page = pages[1]
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.get_by_role("region", name="Seconds per case against MAE (HU)").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('figure .scroll').scrollLeft > 0")


def test_facts_are_rounded_what_is_not_known_is_left_out_and_files_say_what_they_are(shown, tmp_path):
    finish(tmp_path, "anna", "sirt", misfit=0.002272926038131118, diverged_at=None, misfit_per_view=[0.1, None, 0.3],
           seconds={"sample": 10.141537, "score": 2.0}, settings={"detector": [448, 448], "names": ["a", "b"]})
    results_page(tmp_path)
    page = shown("#sirt%2Fanna", folder=tmp_path)
    page.click("summary")
    facts = page.inner_text("#facts").split("\n")
    assert {"0.002273", "sample 10.14 s, score 2 s", "6 x 9 x 7", "0.1, –, 0.3"} < set(facts)
    assert "diverged at" not in facts and '"detector": [448, 448]' in page.inner_text("#settings")
    files = page.locator("#files li").all_inner_texts()
    assert "volume.nii.gz: the reconstruction in HU" in files and not re.search("thumbnail|view.js", str(files))
