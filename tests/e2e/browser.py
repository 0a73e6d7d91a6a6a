"""A real browser on the product's pages, and the words a person would use for what they do there.

Tests that click through the main job use these, so that a changed button is mended in one place. Everything the
browser complains about (script errors, blocked loads, requests to other hosts) is collected and must be empty.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlparse

from playwright.sync_api import Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: Headless without a sandbox (containers run as root) and without calling home; WebGL still works, in software.
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync"]  # fmt: skip
DESKTOP = {"width": 1280, "height": 900}
TABLET = {"width": 768, "height": 1024}


class Visitor:
    """One person at one screen. ``complaints`` lists everything the browser found wrong."""

    def __init__(self, page: Page, address: str) -> None:
        self.page = page
        self.address = address
        self.complaints: list[str] = []
        page.on("console", lambda message: self._console(message.type, message.text))
        page.on("pageerror", lambda error: self.complaints.append(f"{page.url}: {error}"))
        page.on("request", lambda request: self._request(request.url))

    def _console(self, kind: str, text: str) -> None:
        if kind == "error":  # blocked loads and script errors; warnings are hints about speed
            self.complaints.append(f"{self.page.url}: {text}")

    def _request(self, url: str) -> None:
        if urlparse(url).scheme in ("http", "https") and not url.startswith(self.address):
            self.complaints.append(f"{self.page.url} asked another host: {url}")

    def go(self, path: str) -> Page:
        answer = self.page.goto(self.address + path)
        assert answer is not None
        assert answer.status == 200, (path, answer.status)
        return self.page

    def sign_in(self, name: str, password: str) -> None:
        self.page.goto(f"{self.address}/sign-in/")
        self.page.get_by_label("Username").fill(name)
        self.page.get_by_label("Password").fill(password)
        self.page.get_by_role("button", name="Sign in").click()
        self.page.wait_for_url(f"{self.address}/")

    def open_tool(self, code: str) -> None:
        """As a code scanner does: type the label's code and Enter on the first page."""
        self.go("/")
        self.page.keyboard.type(code)  # the search field has the focus
        self.page.keyboard.press("Enter")
        self.page.get_by_role("heading", name=code, exact=True).wait_for()

    def order_scan(self, reason: str = "") -> None:
        """On a tool's page: order all its regions; ends on the page of the visit."""
        self.page.get_by_role("link", name="Scan this tool").click()
        self.page.get_by_label("Reason").fill(reason)
        self.page.get_by_role("button", name="Put in the queue").click()
        self.page.wait_for_url("**/inspections/*/")

    def wait_for_verdict(self, timeout_s: float) -> str:
        """On the page of a visit: wait until every region is through; returns the verdict's word."""
        word = self.page.locator(".hero .word")
        word.filter(has_not_text="Under way").wait_for(timeout=1000 * timeout_s)
        return word.inner_text().strip()

    def wait_for_surface(self, timeout_s: float = 20) -> None:
        """On the page of a scan: wait until the range image is drawn."""
        self.page.locator("#range[data-drawn]").wait_for(timeout=1000 * timeout_s)

    def fits(self) -> bool:
        """True if nothing makes the page scroll sideways."""
        return bool(self.page.evaluate("document.documentElement.scrollWidth <= innerWidth"))


@contextmanager
def visitor(address: str, screen: dict[str, int] = DESKTOP, **options: Any) -> Iterator[Visitor]:
    """A fresh browser with nobody signed in."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            context = browser.new_context(viewport=screen, **options)  # type: ignore[arg-type]
            context.set_default_timeout(15_000)
            yield Visitor(context.new_page(), address)
        finally:
            browser.close()
