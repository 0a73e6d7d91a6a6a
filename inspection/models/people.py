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


class User(AbstractUser):
    """A person who signs in."""

    role = models.CharField(max_length=10, choices=Role, default=Role.VIEWER)

    def at_least(self, role: Role | str) -> bool:
        """True if this person holds ``role`` or a higher one."""
        return self.is_active and Role(self.role).rank >= Role(role).rank
