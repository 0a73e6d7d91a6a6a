"""What Django's own deployment check says about the product with the settings that docker-compose.yml gives it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.postgres import ROOT


def compose_environment(**given: str) -> dict[str, str]:
    """The environment of the app services, with compose's ${NAME:-default} filled in from ``given``."""
    text = (ROOT / "docker-compose.yml").read_text()
    block = re.search(r"environment: &environment\n((?:    .+\n)+)", text)
    assert block is not None
    found = {}
    for line in block.group(1).splitlines():
        name, _, value = line.strip().partition(": ")
        found[name] = re.sub(r"\$\{(\w+):-([^}]*)\}", lambda m: given.get(m.group(1), m.group(2)), value)
    return found


def check(home: Path, **given: str) -> subprocess.CompletedProcess[str]:
    # Browser tests in the same process set the last one for themselves.
    ours = ("DJANGO_SETTINGS_MODULE", "DEBUG", "DJANGO_ALLOW_ASYNC_UNSAFE")
    environment = {k: v for k, v in os.environ.items() if k not in ours}
    return subprocess.run(
        [sys.executable, "manage.py", "check", "--deploy", "--fail-level", "WARNING"],
        cwd=ROOT, text=True, capture_output=True, check=False, timeout=100,
        env={**environment, **compose_environment(**given), "EDGEWATCH_HOME": str(home)},
    )  # fmt: skip


def test_behind_tls_the_check_is_clean(tmp_path: Path) -> None:
    found = check(tmp_path, BEHIND_TLS="1", ALLOWED_HOSTS="edgewatch.mill.example", POSTGRES_PASSWORD="x")
    assert found.returncode == 0, found.stderr
    assert "no issues" in found.stdout
    assert (tmp_path / "secret-key").stat().st_mode & 0o777 == 0o600  # made on the first start, never in the repository


def test_without_tls_it_complains_of_nothing_but_that(tmp_path: Path) -> None:
    found = check(tmp_path, POSTGRES_PASSWORD="x")
    assert sorted(set(re.findall(r"security\.W\d+", found.stderr))) == [
        "security.W004", "security.W008", "security.W012", "security.W016",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["SECRET_KEY", "POSTGRES_PASSWORD"])
def test_no_secret_has_a_default(name: str) -> None:
    assert re.search(rf"\$\{{{name}:-\}}", (ROOT / "docker-compose.yml").read_text())
