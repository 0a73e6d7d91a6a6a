"""Forms about who may sign in."""

from __future__ import annotations

from typing import Any

from django import forms
from django.conf import settings
from django.contrib.auth.forms import AuthenticationForm
from django.contrib.auth.password_validation import validate_password
from django.http import HttpRequest

from inspection.models import User
from inspection.services.sign_in import WaitFirst, begin_attempt, signed_in


class SignInForm(AuthenticationForm):
    """Name and password. Too many wrong ones make the next try wait, whether the name exists or not."""

    def clean(self) -> dict[str, Any]:
        name = self.cleaned_data.get("username")
        address = address_of(self.request)
        if name and self.cleaned_data.get("password"):
            try:
                begin_attempt(name, address)
            except WaitFirst as wait:
                raise forms.ValidationError(str(wait), code="wait") from wait
        cleaned = super().clean()
        user = self.get_user()
        if name and isinstance(user, User):
            signed_in(user, name, address)
        return cleaned


def address_of(request: HttpRequest | None) -> str:
    """Where a request comes from; behind our TLS proxy, what that proxy added last: anybody can write earlier ones."""
    if request is None:
        return ""
    if settings.BEHIND_TLS and (forwarded := request.headers.get("X-Forwarded-For", "")):
        return forwarded.rsplit(",", 1)[-1].strip()
    return str(request.META.get("REMOTE_ADDR", ""))


class PersonForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    """A person, with an optional new password: empty keeps the old one."""

    password = forms.CharField(
        widget=forms.PasswordInput(attrs={"autocomplete": "new-password"}, render_value=False),
        required=False,
        strip=False,
        help_text="At least 10 characters. Empty keeps the present one.",
    )

    class Meta:
        model = User
        fields = ("username", "first_name", "last_name", "role", "is_active")
        labels = {"is_active": "May sign in", "username": "Name to sign in with"}
        help_texts = {"username": "", "is_active": ""}

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if not self.instance.pk:
            self.fields["password"].required = True
            self.fields["password"].help_text = "At least 10 characters."

    def clean(self) -> dict[str, Any]:
        cleaned: dict[str, Any] = super().clean() or self.cleaned_data
        if password := cleaned.get("password"):
            # The person as they will be: a password must not be like the name that is being given.
            names = {name: cleaned.get(name) or "" for name in ("username", "first_name", "last_name")}
            try:
                validate_password(str(password), User(**names))
            except forms.ValidationError as weak:
                self.add_error("password", weak)
        return cleaned

    def save(self, commit: bool = True) -> User:
        if self.cleaned_data["password"]:
            self.instance.set_password(self.cleaned_data["password"])
        saved: User = super().save(commit)
        return saved
