"""The queue on PostgreSQL: tables made by the migrations, row locks that hold, a scan from order to stored frames.

Everything else is run on PostgreSQL and Redis by `make test-postgres`; this much is in every test run.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.postgres import ROOT, missing

#: Races, conditional updates, and one scan all the way.
WHAT = [
    "tests/worker/test_leases.py",
    "tests/inspection/services/test_orders_at_the_same_moment.py",
    "tests/worker/test_running_a_scan.py::test_a_scan_leaves_a_whole_stack_and_its_range_image",
    "tests/worker/test_running_a_scan.py::test_a_database_that_cut_its_connections_is_connected_to_anew",
]


@pytest.mark.skipif(bool(missing()), reason=missing())
@pytest.mark.skipif("TEST_DATABASE_URL" in os.environ, reason="the whole run is on PostgreSQL already")
def test_the_queue_works_on_postgresql() -> None:
    # Plugins of this run (xdist) must not reach into the other.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "EDGEWATCH_", "REDIS_URL"))}
    run = subprocess.run(
        [sys.executable, "-m", "tests.postgres", *WHAT, "-q", "-x"],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-6000:] + run.stderr[-2000:]
    assert " passed" in run.stdout
