"""Passwords cannot be found by trying, people can mistype them, and nobody can lock out a colleague."""

from __future__ import annotations

import datetime as dt
import threading
from typing import Any

import pytest
import time_machine
from django.db import connection
from django.test import Client
from django.utils import timezone

from inspection.models import AuditEvent, SignInFailure, User
from inspection.services.sign_in import FREE_TRIES, WaitFirst, begin_attempt, wait_after

RIGHT = "olga-knows-the-word"


def attempt(name: str, password: str, address: str = "10.0.0.7", **headers: str) -> Any:
    return Client(REMOTE_ADDR=address, headers=headers).post("/sign-in/", {"username": name, "password": password})


def test_the_right_password_lets_in_and_forgets_the_wrong_ones(olga: User) -> None:
    for _ in range(FREE_TRIES - 1):
        assert "do not fit together" in attempt("olga", "guess").content.decode()
    assert attempt("olga", RIGHT).status_code == 302
    assert not SignInFailure.objects.exists()


@pytest.mark.parametrize("name", ["olga", "nobody-of-that-name"])
def test_after_five_wrong_ones_even_the_right_one_waits(olga: User, name: str) -> None:
    """And the answer is the same for a name that does not exist."""
    with time_machine.travel(dt.datetime(2026, 3, 1, 6, 0, tzinfo=dt.UTC), tick=False) as clock:
        for _ in range(FREE_TRIES):
            attempt(name, "guess")
        answer = attempt(name, RIGHT)
        assert answer.status_code == 200
        assert "Too many wrong passwords from here. Wait 60 s" in answer.content.decode()
        clock.shift(61)
        assert "do not fit together" in attempt(name, "guess").content.decode()
        assert "Wait 2 min" in attempt(name, RIGHT).content.decode()
        clock.shift(121)
        if name == "olga":
            assert attempt(name, RIGHT).status_code == 302
            event = AuditEvent.objects.get(verb="sign-in.after_failures")
            assert (event.actor, event.after) == (olga, {"failures": 6, "address": "10.0.0.7"})


def test_another_screen_is_not_locked_and_capitals_do_not_help(olga: User) -> None:
    for _ in range(FREE_TRIES):
        attempt("olga", "guess")
    assert "Too many" in attempt("OLGA", "guess").content.decode()
    assert attempt("olga", RIGHT, address="10.0.0.8").status_code == 302


def test_many_names_from_one_address_wait_too(db: None) -> None:
    began = timezone.now()
    for n in range(50):
        begin_attempt(f"name-{n}", "10.0.0.9", now=began)
    with pytest.raises(WaitFirst):
        begin_attempt("one-more", "10.0.0.9", now=began + dt.timedelta(seconds=30))
    begin_attempt("one-more", "10.0.0.9", now=began + dt.timedelta(seconds=61))


def test_the_wait_doubles_up_to_a_quarter_of_an_hour_and_is_forgotten(db: None) -> None:
    minutes = [wait_after(count, 5).total_seconds() / 60 for count in range(4, 12)]
    assert minutes == [0, 1, 2, 4, 8, 15, 15, 15]
    now = timezone.now()
    SignInFailure.objects.create(name="olga", address="a", count=30, last_at=now - dt.timedelta(hours=2))
    begin_attempt("olga", "a", now=now)
    assert SignInFailure.objects.get().count == 1


@pytest.mark.django_db(transaction=True)
def test_tries_at_the_same_moment_all_count() -> None:
    start = threading.Barrier(12)
    came: list[str] = []

    def one() -> None:
        start.wait()
        try:
            begin_attempt("olga", "a")
            came.append("tried")
        except WaitFirst:
            came.append("waits")
        finally:
            connection.close()

    threads = [threading.Thread(target=one) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert came.count("tried") == FREE_TRIES


def test_behind_the_proxy_the_address_is_what_the_proxy_says(olga: User, settings: Any) -> None:
    for n in range(FREE_TRIES):  # without a proxy the header is anybody's word
        attempt("olga", "guess", **{"X-Forwarded-For": f"1.2.3.{n}"})
    assert SignInFailure.objects.get().address == "10.0.0.7"
    settings.BEHIND_TLS = True
    settings.SECURE_SSL_REDIRECT = False
    attempt("olga", "guess", **{"X-Forwarded-For": "6.6.6.6, 192.168.1.20"})
    assert SignInFailure.objects.filter(address="192.168.1.20").exists()


@pytest.mark.parametrize("password", ["short", "password1234", "olga-olga-ol"])
def test_weak_passwords_are_refused(adam: User, password: str) -> None:
    client = Client()
    client.force_login(adam)
    person = {"username": "olga-olga-ol", "role": "viewer", "is_active": "on", "password": password}
    assert client.post("/people/new/", person).status_code == 422
    assert not User.objects.filter(username="olga-olga-ol").exists()
