"""How the API answers: JSON that every parser takes, and faults as one sentence in ``detail``.

Python writes NaN into JSON and every browser refuses it, so what was not measured is null. A fault never shows a
traceback or a nested error list: a person reads it in the log of another program at night.
"""

from __future__ import annotations

import json
import math
from typing import Any

from django.core.exceptions import PermissionDenied
from django.http import Http404, HttpRequest, HttpResponse
from ninja import NinjaAPI
from ninja.errors import HttpError, ValidationError
from ninja.renderers import BaseRenderer
from ninja.responses import NinjaJSONEncoder

from inspection.services.moves import WrongState
from scanning.errors import Fault


class PlainJson(BaseRenderer):
    """JSON without NaN or Infinity."""

    media_type = "application/json"

    def render(self, request: HttpRequest, data: Any, *, response_status: int) -> str:
        return json.dumps(finite(data), cls=NinjaJSONEncoder, allow_nan=False, ensure_ascii=False)


def finite(data: Any) -> Any:
    """``data`` with null in place of every number that is none."""
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return data


def sentence_of(error: ValidationError) -> str:
    """The first thing wrong with a request: ``exposures_us: Input should be a valid list.``"""
    first = error.errors[0]
    where = ".".join(str(part) for part in first.get("loc", ())[1:] if not str(part).startswith(("order", "payload")))
    what = str(first.get("msg", "not understood")).rstrip(".")
    more = len(error.errors) - 1
    rest = f" (and {more} more)" if more else ""
    return f"{where + ': ' if where else ''}{what}{rest}."


def answer_faults(api: NinjaAPI) -> None:
    """Register the sentences for everything that can go wrong on the caller's side."""

    def said(request: HttpRequest, status: int, sentence: str, **more: str) -> HttpResponse:
        return api.create_response(request, {"detail": sentence, **more}, status=status)

    @api.exception_handler(WrongState)
    def wrong_state(request: HttpRequest, error: WrongState) -> HttpResponse:
        return said(request, 409, str(error), state=error.state)

    @api.exception_handler(Fault)
    def fault(request: HttpRequest, error: Fault) -> HttpResponse:
        return said(request, 422, str(error))

    @api.exception_handler(ValidationError)
    def invalid(request: HttpRequest, error: ValidationError) -> HttpResponse:
        return said(request, 422, sentence_of(error))

    @api.exception_handler(HttpError)
    def http_error(request: HttpRequest, error: HttpError) -> HttpResponse:
        words = str(error)
        if error.status_code == 401:
            words = "Sign in, or send a valid token in the Authorization header: Bearer ewt_…"
        elif error.status_code == 400 and words == "Cannot parse request body":
            words = "The body is not JSON; send an object as the OpenAPI document at /api/v1/openapi.json describes it."
        elif words == "CSRF check Failed":
            words = "The CSRF token is missing or wrong; programs should use an API token instead of a session."
        return said(request, error.status_code, words)

    @api.exception_handler(Http404)
    def missing(request: HttpRequest, error: Http404) -> HttpResponse:
        ours = str(error).endswith(".") and " matches " not in str(error)
        return said(request, 404, str(error) if ours else "There is no such record.")

    @api.exception_handler(PermissionDenied)
    def denied(request: HttpRequest, error: PermissionDenied) -> HttpResponse:
        return said(request, 403, str(error) or "You may not do this.")
