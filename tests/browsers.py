"""A browser without a window, for tests of pages."""

import shutil

import pytest


@pytest.fixture(scope="module")
def browser():
    """Return Chromium as selenium drives it, with its log."""
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (browser and driver):
        pytest.skip("chromium and its driver are not installed")
    options = selenium.ChromeOptions()
    options.binary_location = browser
    for word in (
        "headless",
        "no-sandbox",
        "disable-gpu",
        "disable-dev-shm-usage",
        "window-size=1300,1200",
    ):
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = selenium.Chrome(options, selenium.ChromeService(driver))
    yield opened
    opened.quit()


def wait_for(browser, condition):
    """Wait until a condition holds, 20 s at most."""
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 20, poll_frequency=0.05).until(lambda _: condition())
