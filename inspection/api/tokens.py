"""Makes, finds and withdraws the keys other programs use. A key is shown once, when it is made."""

from __future__ import annotations

import datetime as dt
import hashlib
import secrets

from django.db import transaction
from django.utils import timezone

from inspection.models import ApiToken, Role, User
from inspection.services.audit import audit
from scanning.errors import BadInput

#: Recognisable in a log or a repository by secret scanners.
PREFIX = "ewt_"
#: `last_used_at` is written at most this often: a poller must not turn every read into a write.
USE_NOTED_EVERY = dt.timedelta(minutes=1)


def issue_token(*, owner: User, name: str, scope: str, by: User) -> tuple[ApiToken, str]:
    """Make a token for ``owner`` and return it with its secret, which is kept nowhere.

    Raises BadInput for an empty name, an unknown scope, or scope queue for an owner who may not order scans.
    """
    name = name.strip()
    if not name:
        raise BadInput("A token needs a name: which program will use it?")
    if len(name) > 80:
        raise BadInput(f"The token's name has {len(name)} characters; at most 80 fit.")
    if scope not in ApiToken.Scope.values:
        raise BadInput(f"There is no scope {scope!r}; use {' or '.join(ApiToken.Scope.values)}.")
    if scope == ApiToken.Scope.QUEUE and not owner.at_least(Role.OPERATOR):
        raise BadInput(f"{owner} is a {owner.role} and may not order scans, so no token of theirs may; use scope read.")
    secret = PREFIX + secrets.token_urlsafe(32)
    with transaction.atomic():
        token = ApiToken.objects.create(owner=owner, name=name, start=secret[:10], sha256=_hash(secret), scope=scope)
        audit(by, "token.issued", token, after={"owner": owner.get_username(), "scope": scope})
    return token, secret


def revoke_token(token: ApiToken, by: User) -> None:
    """Make ``token`` useless from now on; its row stays, so that the log still names it."""
    with transaction.atomic():
        if ApiToken.objects.filter(pk=token.pk, revoked_at=None).update(revoked_at=timezone.now()):
            audit(by, "token.revoked", token)
    token.refresh_from_db()


def find_token(secret: str, *, now: dt.datetime | None = None) -> ApiToken | None:
    """Return the live token of ``secret`` whose owner is still active, else None."""
    now = now or timezone.now()
    token = (
        ApiToken.objects.select_related("owner")
        .filter(sha256=_hash(secret), revoked_at=None, owner__is_active=True)
        .first()
    )
    if token is not None and (token.last_used_at is None or now - token.last_used_at > USE_NOTED_EVERY):
        ApiToken.objects.filter(pk=token.pk).update(last_used_at=now)
    return token


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()
