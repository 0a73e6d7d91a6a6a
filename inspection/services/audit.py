"""Who changed what, when and why.

Called inside the transaction of the change itself, so that there is never a change without its line here, nor a line
about a change that was rolled back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.core.serializers.json import DjangoJSONEncoder
from django.db.models import Model

from inspection.models import AuditEvent, User


def audit(
    by: User | None,
    verb: str,
    target: Model,
    before: Mapping[str, Any] | None = None,
    after: Mapping[str, Any] | None = None,
    reason: str = "",
) -> AuditEvent:
    """Note that ``by`` (None: the program itself) did ``verb`` to ``target``.

    ``before`` and ``after`` hold the changed fields only, as plain values or dates.
    """
    return AuditEvent.objects.create(
        actor=by,
        verb=verb,
        target_type=target._meta.model_name or "",
        target_id=target.pk,
        target=str(target)[:200],
        before=_plain(before),
        after=_plain(after),
        reason=reason[:300],
    )


def _plain(values: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if values is None:
        return None
    encoder = DjangoJSONEncoder()
    simple = (str, int, float, bool, list, dict, type(None))
    return {
        name: value if isinstance(value, simple) else str(value) if isinstance(value, Model) else encoder.default(value)
        for name, value in values.items()
    }
