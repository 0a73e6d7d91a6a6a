"""A signed-in browser for each role."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from django.test import Client

from inspection.models import User
from tests.inspection.pages.plant import small_plant


@pytest.fixture
def people(db: None) -> dict[str, User]:
    return small_plant()


@pytest.fixture
def browse(people: dict[str, User]) -> Callable[[str], Client]:
    """`browse("olga")` is a client signed in as Olga the operator."""

    def signed_in(name: str) -> Client:
        client = Client(raise_request_exception=True)
        client.force_login(people[name])
        return client

    return signed_in
