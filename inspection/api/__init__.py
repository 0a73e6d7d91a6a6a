"""Everything people do on the pages, for other programs: ``/api/v1/`` with its OpenAPI document.

Version 1 only grows: a field may be added, none is renamed or taken away, because the program at the other end was
written by somebody who left.
"""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.shortcuts import render
from ninja import NinjaAPI
from ninja.openapi.docs import DocsBase

from inspection.api import ordering, reading  # noqa: F401 - they add their addresses to the router
from inspection.api.answers import PlainJson, answer_faults
from inspection.api.callers import SessionKey, TokenKey
from inspection.api.routes import router


class OfflineDocs(DocsBase):
    """The browsable document, with scripts from this server only."""

    def render_page(self, request: HttpRequest, api: NinjaAPI, **kwargs: object) -> HttpResponse:
        settings = {"url": self.get_openapi_url(api, {}), "layout": "BaseLayout", "deepLinking": True}
        return render(request, "api/docs.html", {"settings": settings, "title": api.title})


api = NinjaAPI(
    title="Edgewatch",
    version="1.0.0",
    description=(
        "Tools, scans, numbers with their uncertainties, queues and due dates. Lengths, volumes and times carry their "
        "unit in the name; null means not measured; u is a standard uncertainty (k = 1). Faults come as one sentence "
        "in `detail`; an order that does not fit the present state is answered with 409 and that state."
    ),
    urls_namespace="api",
    auth=[TokenKey(), SessionKey()],
    renderer=PlainJson(),
    docs=OfflineDocs(),
)
api.add_router("", router)
answer_faults(api)
