"""What holds for every answer: who may have it, and what the browser may load with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from django.contrib.auth.views import redirect_to_login
from django.core.exceptions import BadRequest, PermissionDenied
from django.http import HttpRequest, HttpResponse, HttpResponseBase

from inspection.models import User
from inspection.roles import NEEDED, OWN_AUTHENTICATION, PUBLIC

GetResponse = Callable[[HttpRequest], HttpResponseBase]

#: Scripts only from this server and never inline. Plotly writes style attributes, hence 'unsafe-inline' for styles;
#: it draws heat maps as data: images and saves pictures as blob:.
POLICY: Final = "; ".join(
    [
        "default-src 'self'",
        "script-src 'self'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "object-src 'none'",
        "base-uri 'self'",
        "form-action 'self'",
        "frame-ancestors 'none'",
    ]
)


class ContentSecurityPolicy:
    """Sends the policy with every answer, so that text typed by a person can never run as a script."""

    def __init__(self, get_response: GetResponse) -> None:
        self.get_response = get_response

    def __call__(self, request: HttpRequest) -> HttpResponseBase:
        response = self.get_response(request)
        response.headers.setdefault("Content-Security-Policy", POLICY)
        response.headers.setdefault("Referrer-Policy", "same-origin")
        return response


class PlainText:
    """Refuses text with NUL characters, which no person types and PostgreSQL does not store.

    One place instead of every view: a search field that was forgotten would answer with a fault of the server.
    """

    def __init__(self, get_response: GetResponse) -> None:
        self.get_response = get_response

    def __call__(self, request: HttpRequest) -> HttpResponseBase:
        return self.get_response(request)

    def process_view(
        self, request: HttpRequest, view: Callable[..., HttpResponseBase], args: Any, kwargs: Any
    ) -> HttpResponseBase | None:
        typed = [request.GET, request.POST] if request.method == "POST" else [request.GET]
        for said in typed:
            for values in said.lists():
                if "\0" in values[0] or any("\0" in value for value in values[1] if isinstance(value, str)):
                    raise BadRequest("The request holds a NUL character, which is no text; type it again.")
        return None


class RoleGate:
    """Asks `inspection.roles` before every view. An address without an entry is refused to everybody."""

    def __init__(self, get_response: GetResponse) -> None:
        self.get_response = get_response

    def __call__(self, request: HttpRequest) -> HttpResponseBase:
        return self.get_response(request)

    def process_view(
        self, request: HttpRequest, view: Callable[..., HttpResponseBase], args: Any, kwargs: Any
    ) -> HttpResponseBase | None:
        match = request.resolver_match
        if match is None:
            raise PermissionDenied("This address has no name, so nobody may use it.")
        if any(namespace.startswith(OWN_AUTHENTICATION) for namespace in match.namespaces):
            return None
        name = match.view_name
        if name in PUBLIC:
            return None
        user = request.user
        if not isinstance(user, User):
            return to_sign_in(request)
        needed = NEEDED.get(name)
        if needed is None:
            raise PermissionDenied(f"Nobody has decided yet who may use “{name}”, so it is closed.")
        if not user.at_least(needed):
            raise PermissionDenied(f"This needs the role {needed.label.lower()}; yours is {user.get_role_display()}.")
        return None


def to_sign_in(request: HttpRequest) -> HttpResponseBase:
    """Send to the sign-in page; a fragment asked for by htmx makes the whole page go there."""
    if getattr(request, "htmx", False):
        response = HttpResponse(status=401)
        response["HX-Refresh"] = "true"
        return response
    if request.method not in ("GET", "HEAD"):
        return redirect_to_login("/")
    return redirect_to_login(request.get_full_path())
