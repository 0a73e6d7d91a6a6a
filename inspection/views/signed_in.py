"""What every view shares: a request whose user is one of ours, and the way a fault becomes a message."""

from __future__ import annotations

from typing import Any, TypeVar

from django.contrib import messages
from django.core.exceptions import ObjectDoesNotExist
from django.db.models import Model, QuerySet
from django.forms import BaseForm
from django.http import Http404, HttpRequest, HttpResponse
from django.shortcuts import redirect, render
from django_htmx.middleware import HtmxDetails

from inspection.models import Rig, Scan, User
from scanning.errors import Fault

M = TypeVar("M", bound=Model)

#: The largest number a row can have, in either kind of database.
LARGEST_KEY = 2**63 - 1


class SignedIn(HttpRequest):
    """A request that the role gate let through, so its user is one of ours."""

    user: User
    htmx: HtmxDetails


def refused(form: BaseForm, fault: Fault) -> None:
    """Put the fault's one sentence on the form, above the fields; what was typed stays."""
    form.add_error(None, str(fault))


def form_page(request: HttpRequest, template: str, form: BaseForm, **context: Any) -> HttpResponse:
    """Show a form: 422 when it came back with faults, so that scripts and tests can tell it from a first visit."""
    status = 422 if form.is_bound and form.errors else 200
    return render(request, template, {"form": form, **context}, status=status)


def said(request: HttpRequest, sentence: str) -> None:
    messages.success(request, sentence)


def back_with_fault(request: HttpRequest, fault: Fault, to: str | Scan | Rig) -> HttpResponse:
    """Return to a page with the fault's sentence at its top."""
    messages.error(request, str(fault))
    return redirect(to)


def found(rows: QuerySet[M] | type[M], **lookup: Any) -> M:
    """The one row, or a 404 that says what was looked for."""
    queryset: QuerySet[M] = rows if isinstance(rows, QuerySet) else rows._default_manager.all()
    try:
        if any(isinstance(value, int) and value > LARGEST_KEY for value in lookup.values()):
            raise ObjectDoesNotExist  # no database could even be asked for it
        return queryset.get(**lookup)
    except ObjectDoesNotExist:
        what = queryset.model._meta.verbose_name
        raise Http404(f"There is no {what} {', '.join(str(value) for value in lookup.values())} here.") from None
