"""Signing in and out, one's own password, and who may do what."""

from __future__ import annotations

from django.contrib.auth import update_session_auth_hash
from django.contrib.auth.forms import PasswordChangeForm
from django.contrib.auth.views import LoginView, LogoutView
from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_safe

from inspection.forms.people import PersonForm, SignInForm
from inspection.models import Role, User
from inspection.services.audit import audit
from inspection.views.signed_in import SignedIn, form_page, found, said

sign_in = LoginView.as_view(
    template_name="people/sign_in.html", authentication_form=SignInForm, redirect_authenticated_user=True
)
sign_out = LogoutView.as_view()

ROLE_WORDS = {
    Role.VIEWER: "sees everything, changes nothing",
    Role.OPERATOR: "also orders, pauses and cancels scans, locks rigs, records events, imports stacks",
    Role.ENGINEER: "also tools, regions, limits, calibrations, schedules, computing again, the audit trail",
    Role.ADMIN: "also people",
}


def own_password(request: SignedIn) -> HttpResponse:
    form = PasswordChangeForm(request.user, request.POST or None)
    if request.method == "POST" and form.is_valid():
        form.save()
        update_session_auth_hash(request, request.user)
        audit(request.user, "person.password", request.user)
        said(request, "Your password is changed.")
        return redirect("overview")
    return form_page(request, "people/password.html", form)


@require_safe
def people_page(request: SignedIn) -> HttpResponse:
    people = User.objects.order_by("-is_active", "username")
    return render(request, "people/people.html", {"people": people, "roles": _roles()})


def person_new(request: SignedIn) -> HttpResponse:
    form = PersonForm(request.POST or None, initial={"role": Role.OPERATOR})
    if request.method == "POST" and form.is_valid():
        person = form.save()
        audit(request.user, "person.created", person, after={"role": person.role})
        said(request, f"{person.username} may sign in as {person.get_role_display().lower()}.")
        return redirect("people")
    return form_page(request, "people/person_form.html", form, roles=_roles())


def person_edit(request: SignedIn, pk: int) -> HttpResponse:
    person = found(User, pk=pk)
    before = {"role": person.role, "is_active": person.is_active}
    form = PersonForm(request.POST or None, instance=person)
    if request.method == "POST" and form.is_valid():
        if _last_admin(person, form.cleaned_data["role"], form.cleaned_data["is_active"]):
            form.add_error(None, "Somebody must be able to manage people: make another active admin first.")
        else:
            person = form.save()
            after = {"role": person.role, "is_active": person.is_active}
            audit(request.user, "person.changed", person, before=before, after=after)
            said(request, "Saved.")
            return redirect("people")
    return form_page(request, "people/person_form.html", form, person=person, roles=_roles())


def _last_admin(person: User, role: str, active: bool) -> bool:
    if role == Role.ADMIN and active:
        return False
    return not User.objects.filter(role=Role.ADMIN, is_active=True).exclude(pk=person.pk).exists()


def _roles() -> list[tuple[str, str]]:
    return [(str(role.label), words) for role, words in ROLE_WORDS.items()]
