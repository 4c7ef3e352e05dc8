"""The chromium of Debian without a display, controlled by selenium."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

from tests.harness import proc, wait_for

ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--no-proxy-server",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)


class Browser:
    """One browser with one or more windows."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def run(self, script: str, *arguments: Any) -> Any:
        """Return the result of a script in the page."""
        return self.driver.execute_script(script, *arguments)

    def until(self, script: str, *arguments: Any, what: str = "") -> Any:
        """Run a script until it returns a true value, and return this."""
        return wait_for(lambda: self.run(script, *arguments), what=lambda: f"{what or script}: {self.problems()}")

    def press(self, selector: str) -> None:
        """Wait for an element and click it."""
        self.until("return Boolean(document.querySelector(arguments[0]))", selector)
        self.run("document.querySelector(arguments[0]).click()", selector)

    def resize(self, width: int, height: int, theme: str = "dark", scale: float = 1.0) -> None:
        """Set the size of the window (CSS pixels) and the preferred colour scheme."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        features = [{"name": "prefers-color-scheme", "value": theme}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def problems(self) -> list[str]:
        """Return the errors on the console of the browser."""
        return list(dict.fromkeys(e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"))


@contextmanager
def browser(downloads: Path | None = None) -> Iterator[Browser]:
    """Start a browser with a temporary profile; files are saved to `downloads`."""
    options = Options()
    proc("self")  # Chromium does not start without it
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        for argument in (*ARGUMENTS, f"--user-data-dir={folder}"):
            options.add_argument(argument)
        options.binary_location = "/usr/bin/chromium"
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        driver = webdriver.Chrome(service=Service("/usr/bin/chromedriver"), options=options)
        try:
            if downloads is not None:
                where = {"behavior": "allow", "downloadPath": str(downloads)}
                driver.execute_cdp_cmd("Browser.setDownloadBehavior", where)
            yield Browser(driver)
        finally:
            driver.quit()
