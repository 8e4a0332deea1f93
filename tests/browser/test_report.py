"""The report in a real browser: Debian's chromium, which .ci/run installs where it is root."""

import numpy as np
import pytest
from report_samples import NASTY_NAMES, browser, needs_chromium, read_sample, screenshot_folder, write_run

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.table.words import Member, Reason, ReasonCode
from sfm_audit.reports import html
from sfm_audit.reports.charts.scene import SceneView
from sfm_audit.reports.text.wording import plain

pytestmark = needs_chromium
MAX_BYTES = 15_000_000


@pytest.fixture(scope="module")
def chromium():
    with browser() as running:
        yield running


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    against = [Reason(ReasonCode.PRIORS_DISAGREE, Member.OUTSIDE, "40 m")]
    said = {"witnesses": [["priors"]] * 60, "reason_details": [against] * 5 + [[]] * 55}
    content = html.read_content(read_sample(folder / "RUN", 60, names=NASTY_NAMES, **said))
    pictures = [html.ImagePictures(missing="No pictures: a test.")] * 3
    views = [html.ModelView(content.rows[0]["part"], "a/0", ring(60))]
    path = folder / "report.html"
    path.write_text(html.render_page(html.PageInput(content, pictures, views=views)), encoding="utf-8")
    return path


@pytest.fixture
def page(chromium, page_file):
    """The page, opened without a network; every error in its console fails the test."""
    context = chromium.new_context(offline=True, viewport={"width": 1280, "height": 900})
    opened = context.new_page()
    problems = []
    opened.on(
        "console", lambda message: problems.append(message.text) if message.type in {"error", "warning"} else None
    )
    opened.on("pageerror", lambda error: problems.append(str(error)))
    opened.on(
        "request", lambda request: None if request.url.startswith(("file:", "data:")) else problems.append(request.url)
    )
    opened.goto(page_file.as_uri())
    opened.wait_for_selector("html[data-ready]")
    yield opened
    assert problems == []
    assert opened.evaluate("window.hacked") is None
    context.close()


def ring(n):
    """Cameras on a circle, each sharing points with the next."""
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    centre = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    points = np.random.default_rng(0).normal(0, 0.2, (50, 3))
    pairs = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    return SceneView(np.arange(n) + 1, centre, -centre, up, points, pairs, np.full(n - 1, 7))


def column(page, title):
    index = page.locator("#images thead th").all_inner_texts().index(title) + 1
    return page.locator(f"#images tbody tr td:nth-child({index})").all_inner_texts()


def wait_for_rows(page, words):
    page.locator(".dt-info", has_text=words).wait_for()


def test_sorting_by_mouse_and_by_keyboard(page):
    heading = page.locator("#images thead th", has_text="Misfit, px")
    heading.click()
    page.wait_for_selector("#images th[aria-sort=descending]")
    assert heading.get_attribute("aria-sort") == "descending"
    values = [float(text) for text in column(page, "Misfit, px")]
    assert values == sorted(values, reverse=True)
    heading.get_by_role("button").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#images th[aria-sort=ascending]")
    values = [float(text) for text in column(page, "Misfit, px")]
    assert values == sorted(values)


def test_filters(page):
    page.select_option("#filter-verdict", "rejected")
    wait_for_rows(page, "filtered")
    assert {text.lstrip("✕\u2009? ") for text in column(page, "Verdict")} == {"rejected"}
    page.get_by_role("button", name="Show all").click()
    wait_for_rows(page, "60 entries")
    page.fill("#filter-text", "<script>")
    wait_for_rows(page, "of 1 entry")
    assert column(page, "Image") == [NASTY_NAMES[0]]
    page.select_option("#filter-verdict", "undetermined")
    page.fill("#filter-text", "low_coverage")
    page.locator("#images tbody tr").nth(1).wait_for()
    assert set(column(page, "Why")) == {"low coverage"}


def test_the_panel_of_an_image_and_back(page):
    page.fill("#filter-text", "script")
    wait_for_rows(page, "filtered")
    button = page.get_by_role("button", name=NASTY_NAMES[0])
    button.focus()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog")
    dialog.wait_for()
    assert dialog.get_by_role("heading").inner_text() == NASTY_NAMES[0]
    assert "rms_px" in dialog.inner_text()
    page.screenshot(path=screenshot_folder() / "report-panel.png")
    page.keyboard.press("Escape")
    dialog.wait_for(state="hidden")
    assert page.evaluate("document.activeElement.textContent") == NASTY_NAMES[0]


def test_a_witness_leads_to_the_images_it_speaks_against(page):
    links = page.locator("[aria-labelledby=witnesses] a.open")
    assert links.all_inner_texts() == [plain(name) for name in NASTY_NAMES[:5]]
    links.nth(2).click()
    assert page.locator("#panel-title").inner_text() == NASTY_NAMES[2]


def test_from_the_panel_to_the_pictures(page):
    page.locator("button.open").nth(1).click()
    page.get_by_role("link", name="To its pictures").click()
    assert page.evaluate("document.querySelector('#worst-1').open")
    assert page.evaluate("document.activeElement.parentElement.id") == "worst-1"
    page.locator("button.open").nth(5).click()
    assert not page.locator("#panel-pictures").is_visible()


def test_a_click_on_a_reason_a_verdict_or_a_camera_shows_its_images(page):
    page.locator('a.ask[data-ask="reason"]', has_text="misfit").first.click()
    wait_for_rows(page, "filtered")
    assert page.evaluate("document.activeElement.id") == "images-heading"
    assert all("misfit radial" in text for text in column(page, "Why"))
    page.locator('.totals a.ask[data-value="accepted"]').click()
    page.locator("#images tbody td.verdict", has_text="accepted").first.wait_for()
    assert {text.lstrip("\u2713\u2009") for text in column(page, "Verdict")} == {"accepted"}


def test_a_camera_of_the_scene_leads_to_its_neighbours_and_to_its_panel(page):
    box = page.locator('details[data-view="0"]')
    box.get_by_role("button", name="Next camera").click()
    words = box.get_by_role("status").inner_text()
    assert "shares points with" in words
    assert box.locator(".top .picked circle").count() >= 2
    first = words
    x, y = page.evaluate("[...JSON.parse(document.getElementById('payload').textContent).views[0].top.slice(80, 82)]")
    svg = box.locator(".top svg")
    scale = svg.bounding_box()["width"] / 560
    svg.click(position={"x": x * scale, "y": y * scale})
    assert box.get_by_role("status").inner_text() != first
    assert "(7)" in box.get_by_role("status").inner_text()
    box.get_by_role("button", name="Open its panel").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("link", name="Show it in the scene").click()
    dialog.wait_for(state="hidden")
    assert page.evaluate("document.activeElement.closest('details').dataset.view") == "0"


def test_paper_splits_no_row_and_shows_all_rows_that_the_filters_leave(page):
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.querySelector('#images tbody tr')).breakInside") == "avoid"
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert page.locator("#images tbody tr").count() == 60
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert page.locator("#images tbody tr").count() == 25


def test_the_page_of_diff(chromium, tmp_path, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    for name, seed in (("A", 0), ("B", 3)):
        write_run(tmp_path / name, 40, names=NASTY_NAMES, seed=seed)
    args = ["diff", str(tmp_path / "A"), str(tmp_path / "B"), "--html", str(tmp_path / "d.html")]
    assert main(args) == 0
    context = chromium.new_context(offline=True, viewport={"width": 390, "height": 900})
    page = context.new_page()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto((tmp_path / "d.html").as_uri())
    page.wait_for_selector("html[data-ready]")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.locator('.totals a.ask[data-value="newly rejected"]').click()
    wait_for_rows(page, "filtered")
    assert all("newly rejected" in text for text in column(page, "Change"))
    assert page.evaluate("window.hacked") is None
    assert problems == []
    context.close()


def test_names_read_as_text(page):
    page.select_option(".dt-length select", "100")
    shown = set(column(page, "Image"))
    assert {plain(name) for name in NASTY_NAMES if name} <= shown


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_every_width_and_scheme_fits(chromium, page_file, scheme, width):
    context = chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.goto(page_file.as_uri())
    page.wait_for_selector("html[data-ready]")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(23, 25, 28)")
    page.screenshot(path=screenshot_folder() / f"report-{width}-{scheme}.png", full_page=True)
    context.close()


def test_without_javascript_all_but_the_table_is_there(chromium, page_file):
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(page_file.as_uri())
    assert page.locator("noscript").is_visible()
    assert page.get_by_role("heading", name="What a verdict does not prove").is_visible()
    context.close()


def test_ten_thousand_images_open_and_stay_small(chromium, tmp_path, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    names = [f"scene_{i // 100:04d}/images/{i * 7919 % 99999999:010d}_{i:010d}.jpg" for i in range(10_000)]
    path = tmp_path / "report.html"
    content = html.read_content(read_sample(tmp_path / "RUN", 10_000, names=names))
    path.write_text(html.render_page(html.PageInput(content)), encoding="utf-8")
    assert path.stat().st_size < MAX_BYTES - 12 * 400_000  # room for the pictures of twelve images
    page = chromium.new_context().new_page()
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-ready]")
    assert "10,000" in page.locator(".dt-info").inner_text()
