"""The page of a result in a real browser, without a network: pictures, blink, stretch, keys."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from browsers import wait_for
from result_views import make_view

from lnocl.plotting.report import make_report

LAYERS = ["image", "model", "residuals", "extended source"]
# As wide as that of stars in several epochs.
TABLE = {
    "star": ["1"], "x (pix)": ["1024.25 ± 0.01"], "y (pix)": ["1024.25 ± 0.01"],
    "flux (electron)": ["181 730 ± 310"], "epoch": ["2024-03-01T02:00:00"],
    "variation error (electron)": ["1672"], "ra (deg)": ["165.489087"], "dec (deg)": ["-19.535168"],
    "core rms": ["0.9767"], "wings rms": ["1.017"], "halo": ["8.716e-05"],
}  # fmt: skip
PAGES = sorted((Path(__file__).parents[2] / "docs" / "start" / "look").glob("*.html"))

pytestmark = pytest.mark.system
pytest.importorskip("matplotlib")


@pytest.fixture
def page(browser, tmp_path):
    """Open the page of a view with two images and two stars; return the browser."""
    view = make_view(p=2, n_stars=2)
    y, x = np.indices(view.extended.shape)
    bright = 4000.0 * np.exp(-((x - 10) ** 2 + (y - 20) ** 2) / 8.0)
    view.models[:] += bright
    view.images[:] = view.models + np.sqrt(view.models) * view.residuals
    doubtful = np.zeros(view.extended.shape, bool)
    doubtful[30:40, 30:40] = True
    view = dataclasses.replace(view, doubtful=doubtful)
    path = tmp_path / "report.html"
    path.write_text(make_report(view, "a jet", ["the model fits"], {"Stars": TABLE}))
    browser.get(path.as_uri())
    wait_for(browser, lambda: layer(browser) == "image")
    return browser


def layer(browser):
    return browser.execute_script("return document.querySelector('canvas')?.dataset.layer")


def picture(browser, row=0):
    script = "return document.querySelectorAll('.panels')[arguments[0]].firstChild.toDataURL()"
    return browser.execute_script(script, row)


def colour(browser, x, y):
    """Return the colour at a pixel of the whole frame, in the first picture."""
    script = (
        "const canvas = document.querySelector('canvas'), f = canvas.frame;"
        "const left = f.left + (arguments[0] + 0.5) * f.scale;"
        "const top = f.top + f.height - (arguments[1] + 0.5) * f.scale;"
        "return Array.from(canvas.getContext('2d').getImageData(left, top, 1, 1).data.slice(0, 3))"
    )
    return browser.execute_script(script, x, y)


def choose(browser, name, text):
    from selenium.webdriver.support.ui import Select

    Select(browser.find_element("id", name)).select_by_visible_text(text)


def test_it_loads_without_a_fault_and_asks_for_no_file(page):
    assert page.title == "a jet"
    assert page.get_log("browser") == []
    entries = "return performance.getEntriesByType('resource').map((each) => each.name)"
    assert all(name.startswith("data:") for name in page.execute_script(entries))
    assert "the model fits" in page.find_element("tag name", "body").text


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_the_pages_in_docs_are_shown(path, browser):
    assert path.stat().st_size < 3e6
    browser.get_log("browser")
    browser.get(path.as_uri())
    wait_for(browser, lambda: layer(browser) == "image")
    browser.find_element("tag name", "body").send_keys("4")
    wait_for(browser, lambda: layer(browser) == "extended source")
    assert browser.get_log("browser") == []


def test_each_button_shows_its_picture_and_the_first_shows_all(page):
    shown, row = (
        {},
        "return [...document.querySelector('.panels').children].map(c => c.dataset.layer)",
    )
    everything, *buttons = page.find_elements("css selector", "#layers button")
    for button in buttons:
        button.click()
        wait_for(page, lambda name=button.text: page.execute_script(row) == [name])
        shown[button.text] = picture(page)
        assert button.get_attribute("aria-pressed") == "true"
    assert list(shown) == LAYERS
    assert len(set(shown.values())) == 4
    everything.click()
    wait_for(page, lambda: page.execute_script(row) == LAYERS)


def test_doubtful_pixels_are_outlined_in_red(page):
    page.find_elements("css selector", "#layers button")[4].click()
    wait_for(page, lambda: layer(page) == "extended source")
    red, green, blue = colour(page, 30 - 0.45, 35)
    assert red > 2 * max(green, blue)
    red, green, blue = colour(page, 35, 35)
    assert red < 2 * max(green, blue)


def test_axes_and_colour_bars_have_round_numbers(page):
    steps = page.execute_script("return steps(-0.5, 69.5, 200, 45)")
    assert steps == [0, 20, 40, 60]
    script = "return levels(document.querySelectorAll('canvas')[arguments[0]].frame.layer, 200)"
    image, residuals = (page.execute_script(script, k) for k in (0, 2))
    assert {50, 100, 1000} <= set(image)
    assert sorted(residuals) == [-4, -2, 0, 2, 4]
    bar = (
        "const canvas = document.querySelector('canvas'), f = canvas.frame;"
        "const y = f.top + (arguments[0] ? 1 : f.height - 2), x = f.left + f.width + 12;"
        "return Array.from(canvas.getContext('2d').getImageData(x, y, 1, 1).data.slice(0, 3))"
    )
    dark, bright = (page.execute_script(bar, end) for end in (0, 1))
    assert max(dark) < 90
    assert min(bright[:2]) > 220  # viridis, from violet to yellow


@pytest.mark.parametrize("width", [1300, 400])
def test_tables_are_whole_or_in_a_box_and_the_page_is_as_wide_as_the_screen(page, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        widths = (
            "const box = document.querySelector('.box:has(th)'), all = document.documentElement;"
            "return [all.scrollWidth, all.clientWidth, box.scrollWidth, box.clientWidth]"
        )
        content, screen, table, box = page.execute_script(widths)
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert content <= screen
    assert (table <= box) == (width == 1300)


def test_the_star_is_where_it_should_be(page):
    page.find_element("id", "marks").click()
    choose(page, "stretch", "linear")
    wait_for(page, lambda: colour(page, 10, 20)[0] > 150)  # the yellow end of the palette
    assert colour(page, 60, 50)[0] < 100


def test_the_stretch_changes_the_picture_as_it_should(page):
    brightness = []
    script = "return document.querySelector('canvas').dataset.stretch"
    for name in ("linear", "square root", "asinh", "logarithm"):
        choose(page, "stretch", name)
        wait_for(page, lambda name=name: page.execute_script(script) == name)
        brightness.append(colour(page, 14, 20)[1])  # green grows along the palette
    assert brightness == sorted(brightness)
    assert len(set(brightness)) == 4


def test_it_blinks_by_button_and_by_key(page):
    from selenium.webdriver.common.keys import Keys

    seen = []

    def look():
        if layer(page) not in seen:
            seen.append(layer(page))
        return len(seen) == 4

    page.find_element("id", "blink").click()
    wait_for(page, look)
    assert seen == LAYERS
    body = page.find_element("tag name", "body")
    page.execute_script("document.activeElement.blur()")
    body.send_keys(Keys.SPACE)
    assert page.find_element("id", "blink").get_attribute("aria-pressed") == "false"
    body.send_keys("3")
    wait_for(page, lambda: layer(page) == "residuals")


def test_regions_and_images_are_chosen(page):
    before = picture(page)
    other = {"1 of 2": "2 of 2", "2 of 2": "1 of 2"}
    first = page.execute_script("return document.getElementById('image').selectedOptions[0].text")
    choose(page, "image", other[first])
    wait_for(page, lambda: picture(page) != before)
    before = picture(page, row=1)
    choose(page, "region", "star 2")
    wait_for(page, lambda: picture(page, row=1) != before)


def test_value_under_the_pointer_is_displayed(page):
    from selenium.webdriver import ActionChains

    page.find_element("id", "marks").click()
    canvas = page.find_element("css selector", "canvas")
    frame = page.execute_script(
        "const f = arguments[0].frame; return [f.left, f.top, f.scale]", canvas
    )
    left, top, scale = frame
    right, down = left + 10.5 * scale, top + (60 - 20.5) * scale
    width, height = canvas.size["width"], canvas.size["height"]
    to = int(right - width / 2), int(down - height / 2)  # from the middle
    ActionChains(page).move_to_element_with_offset(canvas, *to).perform()
    wait_for(page, lambda: page.find_element("id", "value").text != "")
    said = page.find_element("id", "value").text
    found = re.fullmatch(r"image \((\d+), (\d+)\): (\S+) electron", said)
    assert (found[1], found[2]) == ("10", "20")
    assert float(found[3]) == pytest.approx(4050, rel=0.1)
