"""Headless Chromium, where it and playwright are installed."""

import os
import shutil
from contextlib import contextmanager

import pytest

# Drawing in 3D on the processor: no test needs a graphics card.
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def opened_browser(*arguments):
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
    if chromium is None:
        pytest.skip("Chromium is not installed")
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=chromium, args=[*root, *(arguments or SOFTWARE)]
        )
        try:
            yield browser
        finally:
            browser.close()
