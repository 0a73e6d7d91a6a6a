"""The one address a trend links to."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.urls import path


def page(request: HttpRequest, pk: int) -> HttpResponse:
    return HttpResponse("a page")


urlpatterns = [path("scans/<int:pk>/", page, name="scan")]
