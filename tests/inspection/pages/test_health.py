"""What a monitor is told, and what a person reads, come from the same signs."""

from __future__ import annotations

import datetime as dt
from typing import Any

import pytest
from django.db import DatabaseError, connection
from django.test import Client
from django.utils import timezone

from inspection.models import Rig

pytestmark = pytest.mark.django_db


def test_it_answers_without_signing_in_and_names_what_is_missing(client: Client) -> None:
    Rig.objects.create(slug="r1", name="Rig 1")
    answer = client.get("/health/")
    assert answer.status_code == 200
    said = answer.json()
    assert said["status"] == "degraded"
    assert said["signs"]["Database"]["tone"] == "ok"
    assert said["signs"]["Doorbell"]["tone"] == "replace"  # the tests run without a broker
    assert "never been seen" in said["signs"]["Rig 1"]["text"]


def test_a_worker_that_fell_silent_is_told_from_one_that_works() -> None:
    from inspection.health import WORKER_SILENT, rigs

    now = timezone.now()
    Rig.objects.create(slug="r1", name="Busy", worker_seen_at=now - dt.timedelta(seconds=5))
    Rig.objects.create(slug="r2", name="Silent", worker_seen_at=now - 2 * WORKER_SILENT)
    tones = {sign.what: sign.tone for sign in rigs()}
    assert tones["Busy"] == "ok"
    assert tones["Silent"] == "replace"


def test_a_database_that_does_not_answer_is_503(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise DatabaseError("gone")

    monkeypatch.setattr(connection, "cursor", refuse)
    answer = client.get("/health/")
    assert answer.status_code == 503
    assert answer.json()["status"] == "down"
