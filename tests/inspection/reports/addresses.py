"""Addresses for testing the reports and the API by themselves, without the pages around them."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.urls import include, path

from inspection.api import api


def page(request: HttpRequest, **kwargs: object) -> HttpResponse:
    return HttpResponse("a page")


urlpatterns = [
    path("", page, name="overview"),
    path("sign-in/", page, name="sign-in"),
    path("scans/<int:pk>/", page, name="scan"),
    path("inspections/<int:pk>/", page, name="inspection"),
    path("tools/<int:pk>/", page, name="tool"),
    path("reports/", include("inspection.reports.urls")),
    path("api/v1/", api.urls),
]
