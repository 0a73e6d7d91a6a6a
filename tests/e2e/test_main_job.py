"""The main job, done as a person does it: `manage.py up` in a new home, then a knife scanned by clicking.

Nothing is faked: embedded Valkey, real workers, the rig's serial port on a pseudo-terminal, a real browser. It is slow
(about a minute), and it is the one test that would notice if the parts no longer fit together.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

pytest.importorskip("playwright")

from tests.e2e.browser import CHROMIUM, visitor

ROOT = Path(__file__).resolve().parents[2]
START_S = 120.0
SCAN_S = 180.0


@dataclass
class Product:
    """A running `manage.py up`, and what it has said so far."""

    process: subprocess.Popen[str]
    said: list[str] = field(default_factory=list)
    heard: threading.Condition = field(default_factory=threading.Condition)

    def listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self.heard:
                self.said.append(line.rstrip())
                self.heard.notify_all()
        with self.heard:
            self.heard.notify_all()

    def wait_for(self, pattern: str, timeout_s: float) -> re.Match[str]:
        """The first match of ``pattern`` in what was said, waiting for it if need be."""

        def match() -> re.Match[str] | None:
            return next((m for line in self.said if (m := re.search(pattern, line))), None)

        with self.heard:
            self.heard.wait_for(lambda: match() is not None or self.process.poll() is not None, timeout_s)
            found = match()
        assert found, f"'up' never said {pattern!r}:\n" + "\n".join(self.said)
        return found


@pytest.fixture
def product(tmp_path: Path) -> Iterator[Product]:
    environment = {
        k: v for k, v in os.environ.items() if k not in ("REDIS_URL", "DATABASE_URL", "DJANGO_SETTINGS_MODULE")
    }
    process = subprocess.Popen(
        [sys.executable, "manage.py", "up", "--no-demo-scan", "--no-history", "--port", "8471"],
        cwd=ROOT,
        env={**environment, "EDGEWATCH_HOME": str(tmp_path / "home")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    running = Product(process)
    ear = threading.Thread(target=running.listen, daemon=True)
    ear.start()
    try:
        yield running
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(60)
        finally:
            process.kill()
        ear.join(10)


@pytest.mark.browser
@pytest.mark.timeout(480)
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium")
def test_an_operator_scans_a_knife_and_takes_the_report_away(product: Product, tmp_path: Path) -> None:
    password = product.wait_for(r"\bolga\s+operator\s+(\S+)", START_S).group(1)
    address = product.wait_for(r"Edgewatch is up: (http://\S+?)/ ", START_S).group(1)

    with visitor(address, accept_downloads=True) as olga:
        olga.sign_in("olga", password)
        olga.open_tool("KN-07")
        olga.order_scan("Start of shift")
        verdict = olga.wait_for_verdict(SCAN_S)
        page = olga.page
        assert verdict.lower() == "replace", "R3 of the demo knife has a large damage"

        with page.expect_download() as taken:
            page.get_by_role("link", name="PDF").first.click()
        report = tmp_path / "report.pdf"
        taken.value.save_as(report)
        assert report.read_bytes().startswith(b"%PDF")

        page.locator("section.region", has=page.get_by_role("heading", name="R3")).get_by_text(
            "See the surface"
        ).click()
        olga.wait_for_surface()
        assert "large" in page.locator("main").inner_text()
        assert olga.complaints == []

    product.process.send_signal(signal.SIGINT)
    assert product.process.wait(60) == 0
    product.wait_for("Everything is stopped", 5)
