"""The page of a calibration says in a sentence how long it holds, and says nothing of the kind of one that is over."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable

import pytest
from django.test import Client
from django.utils import timezone

from inspection.models import Rig, User
from inspection.services.calibrations import add_calibration
from tests.inspection.pages.plant import GAUGE_PAIRS

Browse = Callable[[str], Client]


@pytest.mark.parametrize(
    ("left", "words", "tone"),
    [(200, "The calibration is valid until", ""), (1, "in 1 day.", "tone-watch"), (-3, "3 days ago", "tone-replace")],
)
def test_the_one_in_force_says_how_long_it_holds(
    browse: Browse, people: dict[str, User], left: int, words: str, tone: str
) -> None:
    today = timezone.localdate()
    earlier = Rig.objects.get().calibration_now()
    assert earlier is not None
    row = add_calibration(
        rig=Rig.objects.get(), csv_file=GAUGE_PAIRS, by=people["erik"], artefact="Stair FG-8",
        done_on=today - dt.timedelta(days=60), valid_until=today + dt.timedelta(days=left),
    )  # fmt: skip
    page = browse("vera").get(row.get_absolute_url()).content.decode()
    assert words in page
    assert f'<p class="{tone}">The calibration' in page or (not tone and "<p>The calibration" in page)
    assert "The calibration" not in browse("vera").get(earlier.get_absolute_url()).content.decode()
