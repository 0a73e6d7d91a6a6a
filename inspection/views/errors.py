"""Pages for what cannot be answered. They keep the bar, so that nobody is lost."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.shortcuts import render


def _sentence(exception: Exception | None, otherwise: str) -> str:
    text = str(exception.args[0]) if exception and exception.args and isinstance(exception.args[0], str) else ""
    return text or otherwise


def forbidden(request: HttpRequest, exception: Exception | None = None) -> HttpResponse:
    sentence = _sentence(exception, "Your role does not allow this.")
    return render(request, "403.html", {"sentence": sentence}, status=403)


def not_found(request: HttpRequest, exception: Exception | None = None) -> HttpResponse:
    return render(
        request, "404.html", {"sentence": _sentence(exception, "There is nothing at this address.")}, status=404
    )


def forged(request: HttpRequest, reason: str = "") -> HttpResponse:
    """The form was too old or came from elsewhere (CSRF)."""
    sentence = (
        "This form is no longer valid, perhaps because you signed in anew. Go back, reload the page, send it again."
    )
    return render(request, "403.html", {"sentence": sentence}, status=403)
