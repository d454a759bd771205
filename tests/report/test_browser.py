"""The reports in a real browser (playwright with the system's Chromium): silent, offline, without script, on paper."""

import shutil

import pytest

from .conftest import KINDS

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install -e '.[test]'")
CHROMIUM = next(
    (p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")) if p), None
)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as engine:
        try:
            started = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"Chromium does not start here: {str(error).splitlines()[0]}")
        yield started
        started.close()


@pytest.fixture(params=KINDS)
def opened(browser, folders, request):
    """A page with what it asked for and what it complained of."""
    context = browser.new_context(viewport={"width": 1000, "height": 800}, java_script_enabled=False)
    page = context.new_page()
    asked, said = [], []
    page.on("request", lambda r: asked.append(r.url))
    page.on("console", lambda m: said.append(m.text))
    page.on("pageerror", lambda e: said.append(str(e)))
    page.goto((folders[request.param] / "report.html").as_uri())
    yield page, asked, said
    context.close()


def test_no_request_leaves_the_file_and_nothing_is_said(opened):
    page, asked, said = opened
    outside = [u for u in asked if not u.startswith("data:")]
    assert outside == [page.url] and said == []


def test_every_figure_is_named_and_seen_without_script(opened):
    page, _, _ = opened
    figures = page.locator("figure")
    for k in range(figures.count()):
        image = figures.nth(k).get_by_role("img")
        assert image.count() == 1 and len(image.get_attribute("aria-label")) > 5
        box = image.bounding_box()
        assert box["width"] > 300 and box["height"] > 80 and box["x"] + box["width"] <= 1000
    assert page.get_by_role("heading", level=1).count() == 1 and page.get_by_role("main").count() == 1
    assert page.locator(".banner .head").is_visible()


def test_prints_and_fits_a_telephone(opened):
    page, _, _ = opened
    paper = page.pdf(format="A4")
    assert paper.startswith(b"%PDF") and len(paper) > 10_000
    page.set_viewport_size({"width": 390, "height": 800})
    box = page.locator("main").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= 390
    for figure in page.locator("figure svg").all():
        box = figure.bounding_box()
        assert box["x"] + box["width"] <= 391


def test_links_lead_where_they_say(browser, folders):
    context = browser.new_context()
    page = context.new_page()
    page.goto((folders["fit"] / "report.html").as_uri())
    page.get_by_role("link", name="Inside the model").click()
    assert page.url.endswith("#inside-the-model")
    assert page.get_by_role("heading", name="Inside the model").is_visible()
    page.keyboard.press("Tab")
    context.close()
