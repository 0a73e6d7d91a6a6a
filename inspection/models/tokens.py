"""Keys for other programs. A token acts as its owner, never with more rights, and only as far as its scopes go."""

from __future__ import annotations

from django.conf import settings
from django.db import models


class ApiToken(models.Model):
    """A key of one person for one program. Only its SHA-256 is kept: a stolen database opens nothing.

    The secret has 256 random bits, so a plain hash is enough; slow hashes are for passwords people can remember.
    """

    class Scope(models.TextChoices):
        READ = "read", "read everything"
        QUEUE = "queue", "read, order and cancel scans"

    owner = models.ForeignKey(settings.AUTH_USER_MODEL, on_delete=models.CASCADE, related_name="api_tokens")
    name = models.CharField(max_length=80, help_text="Which program uses it.")
    start = models.CharField(max_length=12, help_text="The token's first characters, to tell tokens apart.")
    sha256 = models.CharField(max_length=64, unique=True)
    scope = models.CharField(max_length=5, choices=Scope, default=Scope.READ)
    created_at = models.DateTimeField(auto_now_add=True)
    last_used_at = models.DateTimeField(null=True, blank=True)
    revoked_at = models.DateTimeField(null=True, blank=True)

    class Meta:
        ordering = ["owner_id", "name", "pk"]

    def __str__(self) -> str:
        return f"{self.name} ({self.start}…)"
