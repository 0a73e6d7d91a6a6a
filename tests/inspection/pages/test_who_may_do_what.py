"""Every address asks one table who may use it, and no address is missing from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from django.test import Client
from django.urls import URLPattern, URLResolver, get_resolver, reverse

from inspection.models import Role, User
from inspection.roles import NEEDED, OWN_AUTHENTICATION, PUBLIC

PEOPLE = {"vera": Role.VIEWER, "olga": Role.OPERATOR, "erik": Role.ENGINEER, "adam": Role.ADMIN}


def addresses(
    resolver: URLResolver, namespace: tuple[str, ...] = ()
) -> Iterator[tuple[str | None, dict[str, object], tuple[str, ...]]]:
    """(name, example arguments, namespaces) of every address of the site."""
    for entry in resolver.url_patterns:
        if isinstance(entry, URLResolver):
            yield from addresses(entry, (*namespace, entry.namespace) if entry.namespace else namespace)
        elif isinstance(entry, URLPattern):
            examples = {name: "rig1" if name == "slug" else 999999 for name in entry.pattern.converters}
            yield entry.name, examples, namespace


def ours() -> list[tuple[str | None, dict[str, object]]]:
    return [
        (name, examples)
        for name, examples, spaces in addresses(get_resolver())
        if not any(space.startswith(OWN_AUTHENTICATION) for space in spaces)
    ]


def test_every_address_has_a_role() -> None:
    missing = [name for name, _ in ours() if name not in NEEDED and name not in PUBLIC]
    assert missing == [], "nobody decided who may use these; add them to inspection/roles.py"


def test_the_table_names_no_address_that_is_gone() -> None:
    assert sorted(set(NEEDED) - {name for name, _ in ours()}) == []


@pytest.mark.parametrize("name", PEOPLE)
def test_each_role_reaches_its_own_addresses_and_no_other(name: str, browse: Callable[[str], Client]) -> None:
    client = browse(name)
    for address, examples in ours():
        if address is None or address in PUBLIC or address == "sign-out":
            continue
        answer = client.get(reverse(address, kwargs=examples))
        allowed = PEOPLE[name].rank >= NEEDED[address].rank
        assert (answer.status_code != 403) == allowed, (address, answer.status_code)


def test_a_stranger_is_sent_to_sign_in_everywhere(db: None) -> None:
    client = Client()
    for address, examples in ours():
        if address is None or address in PUBLIC:
            continue
        url = reverse(address, kwargs=examples)
        for answer in (client.get(url), client.post(url)):
            assert answer.status_code == 302, (address, answer.status_code)
            assert answer["Location"].startswith(reverse("sign-in")), address


def test_a_fragment_asked_for_by_a_stranger_makes_the_page_sign_in(db: None) -> None:
    answer = Client().get(reverse("queue-rows", args=["rig1"]), headers={"HX-Request": "true"})
    assert answer.status_code == 401
    assert answer["HX-Refresh"] == "true"


def test_a_deactivated_person_is_out_at_once(browse: Callable[[str], Client], people: dict[str, User]) -> None:
    client = browse("olga")
    User.objects.filter(pk=people["olga"].pk).update(is_active=False)
    assert client.get("/").status_code == 302


def test_the_refusal_names_the_role_it_needs(browse: Callable[[str], Client]) -> None:
    answer = browse("vera").get(reverse("people"))
    assert answer.status_code == 403
    assert "needs the role admin; yours is Viewer" in answer.content.decode()


def test_the_last_admin_cannot_lock_everybody_out(browse: Callable[[str], Client], people: dict[str, User]) -> None:
    adam = people["adam"]
    form = {"username": "adam", "role": "viewer", "is_active": "on", "first_name": "", "last_name": "", "password": ""}
    answer = browse("adam").post(reverse("person-edit", args=[adam.pk]), form)
    assert answer.status_code == 422
    assert "make another active admin first" in answer.content.decode()
    adam.refresh_from_db()
    assert adam.role == Role.ADMIN


def test_a_new_person_can_sign_in_with_the_password_given(browse: Callable[[str], Client]) -> None:
    form = {"username": "nina", "role": "operator", "is_active": "on", "password": "planes-and-knives"}
    assert browse("adam").post(reverse("person-new"), form).status_code == 302
    stranger = Client()
    signed = stranger.post(reverse("sign-in"), {"username": "nina", "password": "planes-and-knives"})
    assert signed.status_code == 302
    assert stranger.get("/").status_code == 200


def test_a_weak_password_is_refused_with_the_reason(browse: Callable[[str], Client]) -> None:
    answer = browse("adam").post(
        reverse("person-new"), {"username": "nina", "role": "viewer", "is_active": "on", "password": "short"}
    )
    assert answer.status_code == 422
    assert "at least 10 characters" in answer.content.decode()
    assert not User.objects.filter(username="nina").exists()
