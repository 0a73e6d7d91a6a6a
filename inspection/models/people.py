"""Who may do what. Four roles, each holding the rights of those before it; `inspection/roles.py` maps pages to them."""

from __future__ import annotations

from django.contrib.auth.models import AbstractUser
from django.db import models


class Role(models.TextChoices):
    VIEWER = "viewer"
    OPERATOR = "operator"
    ENGINEER = "engineer"
    ADMIN = "admin"

    @property
    def rank(self) -> int:
        return list(Role).index(self)


class SignInFailure(models.Model):
    """Wrong passwords for one name from one address, counted until it is let in or enough time has passed.

    ``name`` is what was typed, known or not, so that the answer does not tell which names exist.
    """

    name = models.CharField(max_length=150)
    address = models.CharField(max_length=45)
    count = models.PositiveIntegerField(default=0)
    last_at = models.DateTimeField()

    class Meta:
        constraints = [models.UniqueConstraint(fields=["name", "address"], name="failures_once_per_name_and_address")]
        indexes = [models.Index(fields=["last_at"])]

    def __str__(self) -> str:
        return f"{self.count} failures of {self.name!r} from {self.address}"


class User(AbstractUser):
    """A person who signs in."""

    role = models.CharField(max_length=10, choices=Role, default=Role.VIEWER)

    def at_least(self, role: Role | str) -> bool:
        """True if this person holds ``role`` or a higher one."""
        return self.is_active and Role(self.role).rank >= Role(role).rank
