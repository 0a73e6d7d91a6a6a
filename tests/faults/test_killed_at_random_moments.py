"""Whoever dies at whatever moment of a scan: nothing lost, nothing doubled, nothing stuck, the laser dark.

One moment of each kind in every test run; `make test-faults` takes fifty of each and prints the table.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from inspection.api.tokens import issue_token
from inspection.models import Rig, Scan, Tool, User
from inspection.services import ring as doorbell
from inspection.states import ENDED
from tests.faults import kills
from tests.faults.plant import plant
from tests.postgres import free_port
from worker.lease import LEASE_S

MOMENTS = int(os.environ.get("TEST_KILLS", "1"))
WHO = [
    who for who in kills.WHO if who.split()[0] in os.environ.get("TEST_KILLED", "rig compute web tick broker").split()
]
pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.timeout(120 if MOMENTS == 1 else 0)]


@pytest.fixture
def site(make_tool: Callable[..., Tool], rig: Rig, olga: User, settings: object) -> Iterator[kills.Site]:
    with plant() as made:
        Rig.objects.update(config=made.simulated_rig(speed_up=20.0), exposures_us=[300])
        rig.refresh_from_db()
        _, token = issue_token(owner=olga, name="test", scope="queue", by=olga)
        tool = make_tool(regions=1, length_mm=1.5, rows=64)
        yield kills.Site(made, tool, rig, olga, free_port(), token)
    doorbell._sender.cache_clear()


def test_a_death_at_any_moment_loses_nothing_and_doubles_nothing(site: kills.Site) -> None:
    def say(text: str) -> None:
        print(text)
        if report := os.environ.get("TEST_KILLS_REPORT"):
            with Path(report).open("a") as out:
                print(text, file=out)

    site.up()
    site.usual_s()  # the first compiles
    usual_s = site.usual_s()
    say(f"A scan takes {usual_s:.1f} s from the order to its verdict.")
    tallies = [kills.run(site, who, MOMENTS, usual_s, say if MOMENTS > 1 else lambda _: None) for who in WHO]

    for tally in tallies:
        say(tally.row())
        for note in tally.notes:
            say(f"    {note}")
    for tally in tallies:
        assert (tally.lost, tally.doubled, tally.stuck, tally.broken_frames) == (0, 0, 0, 0), tally
        # The lease, the look for those that ran out, and two slow cores.
        assert max(tally.dark_after_s, default=0.0) < 5.0
        if tally.who == "rig worker":
            assert max(tally.true_after_s, default=0.0) < LEASE_S + 6.0
    assert not Scan.objects.exclude(state__in=ENDED).exists()
