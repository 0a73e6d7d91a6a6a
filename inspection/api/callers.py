"""Who calls the API, and what that caller may do: the same four roles as on the pages.

A program shows a token, a browser its session. A token never does more than its owner, and only as far as its scope.
"""

from __future__ import annotations

from dataclasses import dataclass

from django.http import HttpRequest
from ninja.errors import HttpError
from ninja.security import APIKeyCookie, HttpBearer

from inspection.api.tokens import find_token
from inspection.models import ApiToken, Role, User


@dataclass(frozen=True)
class Caller:
    """The person behind a call; ``token`` is None for a browser session."""

    user: User
    token: ApiToken | None = None

    def may(self, role: Role) -> bool:
        if self.token is not None and role != Role.VIEWER and self.token.scope != ApiToken.Scope.QUEUE:
            return False
        return self.user.at_least(role)


class TokenKey(HttpBearer):
    """``Authorization: Bearer ewt_...``"""

    def authenticate(self, request: HttpRequest, token: str) -> Caller | None:
        found = find_token(token.strip())
        return Caller(found.owner, found) if found else None


class SessionKey(APIKeyCookie):
    """The session of somebody signed in on the pages; writing calls also need the CSRF header."""

    param_name = "sessionid"

    def __call__(self, request: HttpRequest) -> Caller | None:
        if "Authorization" in request.headers or not request.user.is_authenticated:
            return None  # a wrong token must not fall back on whoever is signed in
        found = super().__call__(request)
        return found if isinstance(found, Caller) else None

    def authenticate(self, request: HttpRequest, key: str | None) -> Caller | None:
        return Caller(request.user) if isinstance(request.user, User) and request.user.is_active else None


def caller(request: HttpRequest, role: Role = Role.VIEWER) -> User:
    """Return the person calling, or answer 403 with what is missing. Call it first in every operation."""
    found = getattr(request, "auth", None)
    if not isinstance(found, Caller):
        raise HttpError(401, "Sign in, or send a token in the Authorization header.")
    if not found.may(role):
        if found.user.at_least(role):
            raise HttpError(403, "This token may only read; use one with the scope queue.")
        raise HttpError(403, f"This needs the role {role.label.lower()}; {found.user} is a {found.user.role}.")
    return found.user
