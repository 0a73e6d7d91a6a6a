"""Rows that can be added but never changed.

A verdict points at the limits, calibration and recipe it was judged by. If those rows could be edited, last year's
verdict would change its meaning without anybody noticing (QATrack+ warns its users of exactly this).
"""

from __future__ import annotations

from typing import Any, NoReturn

from django.db import models


class InsertOnlyError(RuntimeError):
    """Somebody tried to change a row that results depend on."""


class InsertOnlyQuerySet(models.QuerySet[Any]):
    def update(self, **kwargs: Any) -> NoReturn:
        raise InsertOnlyError(f"{self.model.__name__} rows are never changed; add a new one.")

    def delete(self) -> NoReturn:
        raise InsertOnlyError(f"{self.model.__name__} rows are never deleted; results point at them.")


class InsertOnly(models.Model):
    """Base of rows that are written once."""

    objects = InsertOnlyQuerySet.as_manager()

    class Meta:
        abstract = True

    def save(self, *args: Any, **kwargs: Any) -> None:
        if not self._state.adding:
            raise InsertOnlyError(f"{type(self).__name__} {self.pk} is never changed; add a new one.")
        super().save(*args, **kwargs)

    def delete(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise InsertOnlyError(f"{type(self).__name__} {self.pk} is never deleted; results point at it.")
